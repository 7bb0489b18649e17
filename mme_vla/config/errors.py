"""What a failed composition means in terms of the YAML tree: the near names, and values of the wrong kind."""

import os
import pickle
import re
import select
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from functools import cache
from types import FrameType
from typing import Any, TextIO

import hydra
import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from mme_vla.errors import UserError, did_you_mean, missing_extra, printable
from mme_vla.utils.io import disk_trouble

DISK_TROUBLE, MISTAKE = 1, 2  # exit codes; a signal's is 128 and its number, as a shell has it


class Terminated(KeyboardInterrupt):
    """SIGTERM: what a scheduler sends before it kills. Whatever tidies up after Ctrl-C does so after this."""


@contextmanager
def print_user_errors() -> Iterator[None]:
    """Surround a command: what is not a bug ends the process with a sentence instead of a traceback.

    A `UserError` ends with code 2, a disk that refuses (full, read-only, too many files) with 1, Ctrl-C with 130 and
    SIGTERM with 143. Where the reader of standard output closes it, as `| head` does, the command ends quietly. Other
    exceptions pass.
    """
    with _terminable():
        try:
            yield
        except BrokenPipeError:
            if not _has_no_reader(sys.stdout):
                raise
        except UserError as error:
            _say(f"Error: {error}", "Error: ")
            raise SystemExit(MISTAKE) from None
        except KeyboardInterrupt as stop:
            number = signal.SIGTERM if isinstance(stop, Terminated) else signal.SIGINT
            name = "SIGTERM" if number == signal.SIGTERM else "Ctrl-C"
            _say(f"Stopped by {name}. What was finished is kept: the same command continues from there.", "Stopped")
            raise SystemExit(128 + number) from None
        except Exception as error:
            sentence = disk_trouble(error)
            if sentence is None:
                raise
            _say(f"Error: {sentence}", "Error: ")
            raise SystemExit(DISK_TROUBLE) from None
        finally:
            try:
                sys.stdout.flush()
            except BrokenPipeError:  # what is still to be written has no reader
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _has_no_reader(stream: TextIO) -> bool:
    """Whether a stream is a pipe whose other end is closed."""
    poll = select.poll()
    poll.register(stream, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


@contextmanager
def _terminable() -> Iterator[None]:
    """Turn SIGTERM into an exception while this is open, where the process would just have died of it."""
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def terminate(number: int, frame: FrameType | None) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _say(text: str, bold: str) -> None:
    from rich.console import Console
    from rich.text import Text

    remaining = printable(text.removeprefix(bold))
    try:
        Console(stderr=True, soft_wrap=True).print(Text(bold, "bold red"), Text(remaining), sep="")
    except OSError:  # the terminal, or the disk that standard error goes to, is what gave way
        sys.stderr = None


COMPOSITION_ERRORS = (HydraException, OmegaConfBaseException, yaml.YAMLError, ValueError)
_BAD_KEY = re.compile(r"Could not override '(.+)'\.\n|Could not delete from config\. '(.+)' does not exist")


class ConfigTree:
    """The tree under the user's choices of groups, before any of their values. Needs an initialised Hydra.

    Args:
        fixed: only the library's own files are read, which do not change: what they compose to is remembered.
    """

    def __init__(
        self, loader: ConfigLoader, config_name: str, overrides: Sequence[Override], fixed: bool = False
    ) -> None:
        self.loader = loader
        self.config_name = config_name
        self.fixed = fixed
        self.overrides = overrides
        names = [o for o in overrides if "." not in o.key_or_group]  # a key with dots is no group
        searched = loader.repository if fixed and isinstance(loader, ConfigLoaderImpl) else loader
        self.choices = [o for o in names if searched.get_group_options(o.key_or_group)]
        self.values = [o for o in overrides if o not in self.choices]

    def composed(self, words: Sequence[str]) -> DictConfig:
        """What Hydra composes from the overrides, which are `words`.

        Of the library's own files the choices are composed once, and Hydra then sets the values: a fifth of the time.
        """
        are_simple = all(isinstance(o.value(), str) and not o.is_add() and not o.is_delete() for o in self.choices)
        are_default = not any(str(o.key_or_group).startswith("hydra") or o.is_sweep_override() for o in self.overrides)
        if self.fixed and are_simple and are_default:
            with suppress(*COMPOSITION_ERRORS):  # Hydra's own way has the words for it
                cfg = self._selection()
                ConfigLoaderImpl._apply_overrides_to_config(self.values, cfg)
                return cfg
        return hydra.compose(self.config_name, list(words))

    def defaults(self) -> Any:
        """Compose with the group choices alone, as plain containers; not to be changed."""
        if self.fixed:
            return _remembered_defaults(self.config_name, self._words())
        return OmegaConf.to_container(self._selection())

    def _selection(self) -> DictConfig:
        return pickle.loads((_remembered if self.fixed else _pickled)(self.config_name, self._words()))

    def _words(self) -> tuple[str, ...]:
        return tuple(str(choice.input_line) for choice in self.choices)

    def explain(self, error: Exception) -> str:
        """Say what was misspelt, with the near names; Hydra's own words where nothing was."""
        if isinstance(error, MissingConfigException) and error.missing_cfg_file:
            group, _, name = error.missing_cfg_file.rpartition("/")
            if group == "hydra/launcher":
                return str(missing_extra(f"launcher={name}", "sweep"))
            options = error.options or [n for n in self.loader.get_group_options(group) if not n.startswith("_")]
            return f"Unknown {group or 'config'} {name!r}. {did_you_mean(name, options)}"
        for choice in self.choices:
            if not isinstance(choice.value(), str | list | None):
                options = self.loader.get_group_options(choice.key_or_group)
                return f"{choice.input_line!r} names no config of the group. Known: {', '.join(options)}."
        if isinstance(error, yaml.YAMLError):
            return f"Cannot read a config file: {error}"
        text = str(error) or str(error.__cause__)
        try:
            defaults = self.defaults()
        except COMPOSITION_ERRORS:  # it is a choice that does not fit
            return text
        memory_lines = [o.input_line for o in self.values if str(o.key_or_group).startswith("memory.")]
        if memory_lines and isinstance(members := defaults.get("memory"), list):
            names = ", ".join(str(m.get("name") if isinstance(m, Mapping) else m) for m in members)
            return (
                f"{memory_lines[0]!r}: the model's file gives memory as the list [{names}], without keys. In that file "
                f"write `/memory: joined` under defaults and `memory: {{members: [{names}]}}`: the same memory with "
                f"keys. Or choose it on the command line, memory=[{names.replace(' ', '')}], for a model with a memory."
            )
        unknown = _BAD_KEY.match(text)
        key = (unknown[1] or unknown[2]) if unknown else ""
        if not key or key.startswith("hydra."):
            return text
        for value in (o.value() for o in self.values if o.key_or_group == key):
            known = _select(defaults, key)
            if isinstance(value, Mapping) and isinstance(known, Mapping):
                key = next((f"{key}.{name}" for name in paths(value) if _select(known, name) is None), key)
                return _unknown_key(key, defaults, ()) + f" To add it: +{key}=…"
        return _unknown_key(key, defaults, self.loader.list_groups(""))

    def check_kinds(self) -> None:
        """Refuse a value that cannot stand for the default: text for a number, a value for a section."""
        defaults = self.defaults() if self.values else {}
        for override in self.values:
            default = _select(defaults, override.key_or_group)
            value = override.value()
            expected = _expected(default, value)
            if expected and not override.is_delete():
                raise UserError(f"{override.input_line!r} does not fit: {override.key_or_group!r} is {expected}.")


def _pickled(config_name: str, words: tuple[str, ...]) -> bytes:
    return pickle.dumps(hydra.compose(config_name, list(words)))


_remembered = cache(_pickled)


@cache
def _remembered_defaults(config_name: str, words: tuple[str, ...]) -> Any:
    return OmegaConf.to_container(pickle.loads(_remembered(config_name, words)))


def _expected(default: Any, value: Any) -> str:
    """What `default` asks for where `value` is of another kind; empty where it may pass."""
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
    """Walk down `key` as far as it exists and name what is near there, or the same word elsewhere in the tree."""
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
        other_paths = [p for p in everywhere if last == p.split(".")[-1] or last in p.split(".")[-1].split("_")]
        other_paths += [
            name for name in get_close_matches(remaining[0], options) if other_paths and len(remaining) == 1
        ]
    if other_paths:
        return f"Unknown config key {key!r}. Did you mean {' or '.join(map(repr, other_paths[:3]))}?"
    within = f" In {where!r}:" if where else ""
    return f"Unknown config key {key!r}.{within} {did_you_mean(remaining[0], options)}"


def paths(tree: Any, prefix: str = "") -> Iterator[str]:
    """Every dotted key of nested mappings, sections before what is in them."""
    for key, value in tree.items():
        yield f"{prefix}{key}"
        if isinstance(value, Mapping):
            yield from paths(value, f"{prefix}{key}.")
