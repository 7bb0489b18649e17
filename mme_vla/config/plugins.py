"""Modules of the user's own, whose decorators register memories, tasks, players: imported when the
user says so.

What a configuration or command line of the user's names is imported at once. What a checkpoint
names is an untrusted word: it is imported only where the user says `trust_plugins=True`
(`--trust-plugins`), or has imported it already.
"""

import importlib
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError, brief, listed, require
from mme_vla.registry import installed_extensions

TRUST_FLAG, TRUST_WORD = "--trust-plugins", "trust_plugins=true"
"""How one says on a command line that the plugins of a checkpoint may be imported; every command
of the library takes both.
"""

_MODULE = re.compile(r"[^\W\d]\w*(\.[^\W\d]\w*)*")
_imported: dict[str, None] = {}  # in order


def import_plugins(names: Iterable[str]) -> None:
    """Import modules that the user named.

    The current directory counts as importable, so that a file beside the command is enough.
    Installed packages come first, so that no file there takes the place of one.
    """
    for name in names:
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.append(here)
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise  # the plugin was found, something it imports was not
            raise UserError(
                f"No module named {name!r} (from `plugins`). Looked in {here} and the installed"
                " packages; give a dotted module name, not a file name."
            ) from error
        _imported[name] = None


def imported_plugins() -> tuple[str, ...]:
    """The plugins of this process: what a worker process has to import before it can build the same
    things.
    """
    return tuple(_imported)


def plugins_of(config: Any, source: str) -> list[str]:
    """The modules that a configuration names under `plugins`."""
    names = config.get("plugins") or []
    names = [names] if isinstance(names, str) else names
    listing = isinstance(names, Sequence)
    if not listing or not all(isinstance(name, str) and _MODULE.fullmatch(name) for name in names):
        raise UserError(
            f"{source}: plugins={brief(names)} must be a list of modules, such as"
            " [my_package.my_memory]."
        )
    return list(names)


def import_trusted(config: Any, source: str, trust: bool) -> None:
    """Import the plugins that a checkpoint or a receipt names.

    config: the checkpoint's configuration, or what the receipt names.
    source: the checkpoint or receipt, for messages.
    trust: the user has said that what it names may run here.
    """
    names = plugins_of(config, source)
    # Parts of installed packages are imported when they are built. Every text of the configuration
    # may name one, wherever it is: the kind of a part is known only then.
    modules_of: dict[str, list[str]] = {}  # a policy and its processor may have one name
    for extension in installed_extensions():
        for parts in extension.parts.values():
            for name, module in parts.items():
                modules_of.setdefault(name, []).append(module)
    required = dict.fromkeys(names)  # in order, each once
    if modules_of:
        for text in _texts(config):
            required |= dict.fromkeys(modules_of.get(text, ()))
    strange = [name for name in required if name not in sys.modules]
    require(
        not strange or trust,
        f"{source} needs the plugin {listed(strange)}: code that it names and that"
        f" would run on this machine. If you know it and trust it, say so with {TRUST_FLAG} (from"
        " Python trust_plugins=True), and start where the module can be found: in its folder, or"
        " with it installed.",
    )
    import_plugins(names)


def _texts(values: Any) -> Iterator[str]:
    if isinstance(values, str):
        yield values
    elif isinstance(values, Mapping):
        for value in values.values():
            yield from _texts(value)
    elif isinstance(values, Sequence):
        for value in values:
            yield from _texts(value)


def trust_as_override(words: Iterable[str]) -> list[str]:
    """A command line whose `--trust-plugins` is written as an override, for commands that read
    overrides.
    """
    return [TRUST_WORD if word == TRUST_FLAG else word for word in words]


def trust_as_flag(words: Iterable[str]) -> list[str]:
    """A command line whose `trust_plugins=true` is written as a flag, for commands
    that read flags.
    """
    return [TRUST_FLAG if word.lower() == TRUST_WORD else word for word in words]
