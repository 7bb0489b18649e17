"""Error messages of a failed composition: near names of what is misspelt, and values of the wrong
kind.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any

import hydra
import yaml
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mme_vla.errors import UserError, brief, did_you_mean, missing_extra

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
        self.loader = loader
        self.config_name = config_name
        self.choices: list[Override] = []
        self.values: list[Override] = []
        for override in overrides:
            name = override.key_or_group
            is_choice = "." not in name and loader.get_group_options(name)
            (self.choices if is_choice else self.values).append(override)

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
            options = error.options or self.loader.get_group_options(group)
            text = f"Unknown {group or 'config'} {name!r}."
            # the models of nano and of Python are composed apart, from the tree `policy`
            command = "mme-vla train " if self.config_name == "policy" else ""
            known = did_you_mean(name, options, f"{command}--help {group}" if group else "")
            file = nearby_file(group, name) if group else None
            if file is not None:
                folder = file.parents[len(Path(group).parts)]
                return f"{text} ./{file} exists: add --config-dir {folder}. {known}"
            return (
                f"{text} {known} A file of your own, DIR/{group}/{name}.yaml, is found with"
                " --config-dir DIR."
            )
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
        members = defaults.get("memory")
        for override in self.values:
            if isinstance(members, list) and override.key_or_group.startswith("memory."):
                return (
                    f"{override.input_line!r}: the model's file gives memory as the list"
                    f" {brief(members)}, without keys. In that file write `/memory: joined` under"
                    " defaults and `memory: {members: […]}` for the same memory with keys. Or"
                    " choose it on the command line, memory=[…], for a model with a memory."
                )
        unknown = _BAD_KEY.match(text)
        if unknown is None:
            return text
        key = unknown[1] or unknown[2]
        if key.startswith("hydra."):
            return text
        known = _select(defaults, key)
        for override in self.values:
            value = override.value()
            is_section = isinstance(value, Mapping) and isinstance(known, Mapping)
            if override.key_or_group == key and is_section:
                for name in paths(value):
                    if _select(known, name) is None:
                        key = f"{key}.{name}"
                        break
                return _unknown_key(key, defaults, ()) + f" To add it: +{key}=…"
        text = _unknown_key(key, defaults, self.loader.list_groups(""))
        named = f"{key.partition('.')[0]}.name"
        if any(override.key_or_group == named for override in self.values):
            text += f" An option of the class that {named} chooses is added with +{key}=…"
        return text

    def check_kinds(self) -> None:
        """Refuse a value of another kind than the default: text for a number, a value for a
        section, or the name of a file for the class of another one's options.
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
            group, _, key = override.key_or_group.rpartition(".")
            is_name = group and key == "name"
            if is_name and value != default and value in self.loader.get_group_options(group):
                raise UserError(
                    f"{override.input_line!r} would keep the options of {default}. Write"
                    f" {group}={value}, which brings its own."
                )


def nearby_file(group: str, name: str) -> Path | None:
    """A file of the user's in or near the current folder, which the command line does not lead
    to.
    """
    path = f"{group}/{name}.yaml"
    for pattern in (f"configs/{path}", path, f"*/{path}", f"*/configs/{path}"):
        files = sorted(Path().glob(pattern))
        if files:
            return files[0]
    return None


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
    section = defaults
    parents: list[str] = []
    remaining = key.split(".")
    while len(remaining) > 1 and isinstance(section, Mapping) and remaining[0] in section:
        parents.append(remaining[0])
        section = section[remaining.pop(0)]
    where = ".".join(parents)
    if where and not section:
        return f"Unknown config key {key!r}: {where!r} has no keys under these choices."
    if not isinstance(section, Mapping):
        return f"Unknown config key {key!r}: {where!r} is a value ({section!r}), not a section."
    options = {str(name) for name in section}
    if not parents:
        options |= set(groups) - {"hydra"}
    everywhere = list(paths(defaults))
    other_paths = [path for path in everywhere if path.rpartition(".")[2] == remaining[0]]
    if not other_paths and not parents:
        # `train.device` where there is `device`, `mode` where there is `subgoal_mode`.
        other_paths = _keys_with_word(remaining[-1], everywhere)
        if other_paths and len(remaining) == 1:
            other_paths += get_close_matches(remaining[0], options)
    if other_paths:
        return (
            f"Unknown config key {key!r}. Did you mean {' or '.join(map(repr, other_paths[:3]))}?"
        )
    within = f" In {where!r}:" if where else ""
    return f"Unknown config key {key!r}.{within} {did_you_mean(remaining[0], options)}"


def _keys_with_word(word: str, keys: Iterable[str]) -> list[str]:
    """The dotted keys that end in this word, then those whose last part has it, as `max_batch` has
    `batch`.
    """
    equal = []
    containing = []
    for key in keys:
        last = key.rpartition(".")[2]
        if last == word:
            equal.append(key)
        elif word in last.split("_"):
            containing.append(key)
    return equal + containing


FORMS = (
    "Write key=value, +key=value to add a key, ~key to remove one; quote values with special"
    " characters."
)


@dataclass(frozen=True)
class Names:
    """What words of a command line may name.

    keys: dotted ones of the configuration.
    groups: group → the names of its files.
    options: with their dashes.
    checkpoints: names of those that ship with the library.
    """

    keys: Sequence[str]
    groups: Mapping[str, Sequence[str]]
    options: Sequence[str] = ()
    checkpoints: Sequence[str] = ()

    def settings_of(self, word: str) -> list[str]:
        """The settings that a word without a key may mean, the likeliest first."""
        settings = []
        is_checkpoint = word in self.checkpoints or Path(word).expanduser().exists()
        if "checkpoint" in self.keys and is_checkpoint:
            settings.append(f"checkpoint={word}")
        elif word in self.groups or word in self.keys:
            return [f"{word}=…"]
        # A model is meant more often than the part of one that has the same name.
        groups = sorted(self.groups, key=lambda group: group != "model")
        settings += [f"{group}={word}" for group in groups if word in self.groups[group]]
        return settings


def unknown_option(option: str, words: Sequence[str], names: Names) -> UserError:
    """What to type instead of an option that there is not: settings are `key=value` words here.

    option: as it was typed, `--steps` or `--steps=10`.
    words: the command line.
    names: what the command knows.
    """
    typed, _, value = option.partition("=")
    near_options = [known for known in names.options if known.startswith(typed)]
    if len(typed) > 3 and near_options:
        # `--config` for `--config-dir`. The folder is what is meant nearly always.
        if "--config-dir" in near_options:
            near_options = ["--config-dir"]
        meant = " or ".join(map(repr, near_options))
        return UserError(
            f"There is no option {typed!r}. Did you mean {meant}? `--config-dir DIR` searches a"
            " folder of YAML files of your own. --help lists all options."
        )
    name = typed.lstrip("-")
    following = words[words.index(option) + 1 :] if option in words else []
    if not value and following and "=" not in following[0] and not following[0].startswith("-"):
        value = following[0]
    word = name.replace("-", "_").rpartition(".")[2]
    near = _keys_with_word(word, names.keys)
    if name in names.groups:
        near = [name]
    if not near:
        keys_of: dict[str, list[str]] = {}  # by their last part
        for key in names.keys:
            keys_of.setdefault(key.rpartition(".")[2], []).append(key)
        for part in get_close_matches(word, keys_of):  # the nearest first
            near += keys_of[part]
    similar = get_close_matches(typed, names.options, cutoff=0.8)
    hint = "--help lists them."
    if near:
        examples = [f"{key}={value or '…'}" for key in near[:3]]
        hint = f"write {' or '.join(examples)}."
    elif similar:
        hint = f"--help lists them. Or did you mean the option {similar[0]!r}?"
    return UserError(
        f"There is no option {option!r}. Settings are words of the form key=value, without dashes:"
        f" {hint}"
    )


def badly_spaced(words: Sequence[str], number: int) -> str | None:
    """What is wrong with a word of a command line that a space cut in two, and how it is typed.

    number: of the word that cannot be read. None where no space is the reason.
    """
    word = words[number]
    following = [*words[number + 1 :], "", ""]
    joined = ""
    if "=" not in word and following[0] == "=":
        joined = f"{word}={following[1]}"
    elif "=" not in word and following[0].startswith("="):
        joined = f"{word}{following[0]}"
    elif "=" not in word and number and words[number - 1].endswith("="):
        joined = f"{words[number - 1]}{word}"
    if joined:
        return f"Cannot read {word!r}: write {joined}, without spaces around =."
    missing = _open_brackets(word)
    if not missing:
        return None
    for end in range(number + 2, len(words) + 1):
        parts = words[number:end]
        if not _open_brackets(" ".join(parts)):
            return (
                f"Cannot read {word!r}: a space ended the word. Write {''.join(parts)}, or quote"
                f" it: '{' '.join(parts)}'."
            )
    return f"Cannot read the override {word!r}: {missing!r} is not closed. {FORMS}"


def _open_brackets(text: str) -> str:
    """The brackets of a text that nothing closes."""
    closes = {")": "(", "]": "[", "}": "{"}
    unclosed: list[str] = []
    for letter in text:
        if letter in closes.values():
            unclosed.append(letter)
        elif unclosed and closes.get(letter) == unclosed[-1]:
            unclosed.pop()
    return "".join(unclosed)


def bare_word(words: Sequence[str], number: int, names: Names) -> str:
    """What to type instead of a word that has no `=`.

    number: of that word in the command line.
    """
    word = words[number]
    following = words[number + 1] if number + 1 < len(words) else "="
    if word in names.groups and "=" not in following:
        return f"Cannot read {word!r}: write {word}={following}."
    settings = names.settings_of(word)
    if not settings:
        near = get_close_matches(word, [*names.groups, *names.checkpoints])
        for name in near:
            settings += names.settings_of(name)
    if not settings:
        return f"Cannot read {word!r}: settings are words of the form key=value. {FORMS}"
    text = f"Cannot read {word!r}: settings are words of the form key=value. Did you mean"
    text += f" {' or '.join(settings[:3])}?"
    if word in names.groups:
        text += f" `--help {word}` lists its names."
    return text


def paths(tree: Any, prefix: str = "") -> Iterator[str]:
    """Every dotted key of nested mappings, sections before what is in them."""
    for key, value in tree.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from paths(value, f"{prefix}{key}.")
