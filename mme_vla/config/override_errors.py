"""Error messages of a failed composition: near names of what is misspelt, and values of the wrong
kind.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from functools import cached_property
from typing import Any

import hydra
import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mme_vla.errors import UserError, did_you_mean, missing_extra

COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException, yaml.YAMLError, ValueError)
_BAD_KEY = re.compile(
    r"Could not override '(.+)'\.\n|Could not delete from config\. '(.+)' does not exist"
)


class ConfigTree:
    """The tree under the user's choices of groups, before any of their values. Needs an initialised
    Hydra.
    """

    def __init__(
        self, loader: ConfigLoader, config_name: str, overrides: Sequence[Override]
    ) -> None:
        self.loader, self.config_name = loader, config_name
        names = [o for o in overrides if "." not in o.key_or_group]  # a key with dots is no group
        self.choices = [o for o in names if loader.get_group_options(o.key_or_group)]
        self.values = [o for o in overrides if o not in self.choices]

    @cached_property
    def defaults(self) -> Any:
        """The composition of the group choices alone, as plain containers."""
        return OmegaConf.to_container(
            hydra.compose(self.config_name, [str(o.input_line) for o in self.choices])
        )

    def explain(self, error: Exception) -> str:
        """Name what is misspelt, with the near names; Hydra's own message where nothing is."""
        if isinstance(error, MissingConfigException) and error.missing_cfg_file:
            group, _, name = error.missing_cfg_file.rpartition("/")
            if group == "hydra/launcher":
                return str(missing_extra(f"launcher={name}", "sweep"))
            options = error.options or [
                n for n in self.loader.get_group_options(group) if not n.startswith("_")
            ]
            return f"Unknown {group or 'config'} {name!r}. {did_you_mean(name, options)}"
        for choice in self.choices:
            if not isinstance(choice.value(), str | list | None):
                options = self.loader.get_group_options(choice.key_or_group)
                return (
                    f"{choice.input_line!r} names no config of the group. Known:"
                    f" {', '.join(options)}."
                )
        if isinstance(error, yaml.YAMLError):
            return f"Cannot read a config file: {error}"
        text = str(error) or str(error.__cause__)
        try:
            defaults = self.defaults
        except COMPOSITION_ERRORS:  # it is a choice that does not fit
            return text
        memory_lines = [
            o.input_line for o in self.values if str(o.key_or_group).startswith("memory.")
        ]
        if memory_lines and isinstance(members := defaults.get("memory"), list):
            names = ", ".join(str(m.get("name") if isinstance(m, Mapping) else m) for m in members)
            return (
                f"{memory_lines[0]!r}: the model's file gives memory as the list [{names}], without"
                " keys. In that file write `/memory: joined` under defaults and `memory:"
                f" {{members: [{names}]}}`: the same memory with keys. Or choose it on the command"
                f" line, memory=[{names.replace(' ', '')}], for a model with a memory."
            )
        unknown = _BAD_KEY.match(text)
        key = (unknown[1] or unknown[2]) if unknown else ""
        if not key or key.startswith("hydra."):
            return text
        for value in (o.value() for o in self.values if o.key_or_group == key):
            known = _select(defaults, key)
            if isinstance(value, Mapping) and isinstance(known, Mapping):
                key = next(
                    (f"{key}.{name}" for name in paths(value) if _select(known, name) is None), key
                )
                return _unknown_key(key, defaults, ()) + f" To add it: +{key}=…"
        return _unknown_key(key, defaults, self.loader.list_groups(""))

    def check_kinds(self) -> None:
        """Refuse a value of another kind than the default: text for a number, a value for a
        section.
        """
        defaults = self.defaults if self.values else {}
        for override in self.values:
            default = _select(defaults, override.key_or_group)
            value = override.value()
            expected = _expected(default, value)
            if expected and not override.is_delete():
                raise UserError(
                    f"{override.input_line!r} does not fit: {override.key_or_group!r} is"
                    f" {expected}."
                )


def _expected(default: Any, value: Any) -> str:
    """The kind that `default` requires where `value` is of another; empty where it is valid."""
    if value is None or default is None or (isinstance(value, str) and "${" in value):
        return ""
    if isinstance(default, Mapping) and not isinstance(value, Mapping):
        return f"a section with the keys {', '.join(map(str, default)) or '(none)'}"
    if isinstance(default, bool):
        return "" if isinstance(value, bool) else "true or false"
    if isinstance(default, int | float) and isinstance(value, str | bool | Mapping):
        return f"a number (default {default})"
    return ""


def _select(tree: Any, key: str) -> Any:
    for part in key.split("."):
        if not isinstance(tree, Mapping):
            return None
        tree = tree.get(part)
    return tree


def _unknown_key(key: str, defaults: Any, groups: Sequence[str]) -> str:
    """Walk down `key` as far as it exists and name what is near there, or the same word elsewhere
    in the tree.
    """
    section, parents, remaining = defaults, [], key.split(".")
    while len(remaining) > 1 and isinstance(section, Mapping) and remaining[0] in section:
        parents.append(remaining[0])
        section = section[remaining.pop(0)]
    where = ".".join(parents)
    if where and not section:
        return f"Unknown config key {key!r}: {where!r} has no keys under these choices."
    if not isinstance(section, Mapping):
        return f"Unknown config key {key!r}: {where!r} is a value ({section!r}), not a section."
    options = {str(name) for name in section} | (set() if parents else set(groups) - {"hydra"})
    everywhere = list(paths(defaults))
    other_paths = [path for path in everywhere if path.split(".")[-1] == remaining[0]]
    if not other_paths and not parents:
        # `train.device` where there is `device`, `mode` where there is `subgoal_mode`.
        last = remaining[-1]
        other_paths = [
            p for p in everywhere if last == p.split(".")[-1] or last in p.split(".")[-1].split("_")
        ]
        other_paths += [
            name
            for name in get_close_matches(remaining[0], options)
            if other_paths and len(remaining) == 1
        ]
    if other_paths:
        return (
            f"Unknown config key {key!r}. Did you mean {' or '.join(map(repr, other_paths[:3]))}?"
        )
    within = f" In {where!r}:" if where else ""
    return f"Unknown config key {key!r}.{within} {did_you_mean(remaining[0], options)}"


def paths(tree: Any, prefix: str = "") -> Iterator[str]:
    """Every dotted key of nested mappings, sections before what is in them."""
    for key, value in tree.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from paths(value, f"{prefix}{key}.")
