"""The text of `--help`: what a command does, examples, and each key with its meaning, from the YAML
files.

`--help` alone shows the command's own keys and the groups with their choices; `--help memory` the
files of a group with their keys, `--help model=framesamp_modul` the keys under these choices.
Nothing here imports PyTorch.
"""

import argparse
import difflib
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from mme_vla.cli import commands, usage
from mme_vla.errors import UserError, did_you_mean


def configured_commands() -> dict[str, str]:
    """File of the tree's top level → how the command that it configures is typed."""
    usages = {command.config: usage(name) for name, command in commands().items() if command.config}
    return usages | {"policy": "build_policy(…)"}


_KEY = re.compile(
    r"^(?P<indent> *(?:- )?)(?P<key>[\w/]+):(?: +(?P<value>[^#]*?))?(?: +# (?P<comment>.*))?$"
)
_PACKAGE = "# @package"


@dataclass(frozen=True)
class Key:
    """One key of a file. name: dotted, within the file. default, comment: as they are written;
    empty where not.
    """

    name: str
    default: str
    comment: str


@dataclass(frozen=True)
class Defaults:
    """The list a file begins with. files: of the top level. groups: group → the file chosen."""

    files: Sequence[str]
    groups: dict[str, str]


def keys(file: Path) -> list[Key]:
    """Every key of a file in its order; the lists `defaults` and `hydra` are left out."""
    result: list[Key] = []
    path: list[str] = []
    for line in file.read_text().splitlines():
        match = _KEY.match(line)
        if not match:
            continue
        depth = len(match["indent"]) // 2
        path = [*path[:depth], match["key"]]
        if path[0] not in ("defaults", "hydra"):
            result.append(
                Key(".".join(path), (match["value"] or "").strip(), match["comment"] or "")
            )
    return result


def explained(file: Path) -> list[Key]:
    """`keys`, with what another file of the group says of a key where this one says nothing."""
    local_keys = keys(file)
    if all(key.comment for key in local_keys):
        return local_keys
    comments = {
        key.name: key.comment
        for other in sorted(file.parent.glob("*.yaml"))
        for key in keys(other)
        if key.comment
    }
    return [
        Key(key.name, key.default, key.comment or comments.get(key.name, "")) for key in local_keys
    ]


def heading(file: Path) -> tuple[list[str], str]:
    """The comment that a file begins with: example commands, and the text after them as one
    paragraph.
    """
    lines: list[str] = []
    for line in file.read_text().splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith(_PACKAGE):
            lines.append(line.lstrip("# "))
    examples = [line for line in lines if line.startswith(("python -m ", "mme-vla "))]
    return examples, " ".join(line for line in lines if line not in examples)


def package(file: Path, group: str) -> str:
    """The section that a group's file fills, with a dot behind it; empty where it fills the top
    level.
    """
    for line in file.read_text().splitlines()[:3]:
        if line.startswith(_PACKAGE):
            name = line.removeprefix(_PACKAGE).strip()
            return "" if name == "_global_" else f"{name}."
    return f"{group.replace('/', '.')}."


def defaults(file: Path) -> Defaults:
    """What a file is composed of; overrides of Hydra's own groups are left out."""
    content = yaml.safe_load(file.read_text()) or {}
    listed: list[Any] = content.get("defaults", []) if isinstance(content, dict) else []
    files = [entry for entry in listed if isinstance(entry, str) and entry != "_self_"]
    groups = {
        str(group): "null" if name is None else str(name)
        for entry in listed
        if isinstance(entry, dict)
        for group, name in entry.items()
    }
    return Defaults(
        files, {group: name for group, name in groups.items() if not group.startswith("override ")}
    )


def choices(trees: Iterable[Path], group: str) -> dict[str, Path]:
    """The files of a group by name, of all trees; a later tree's file stands before an earlier
    one's.
    """
    files = {file.stem: file for tree in trees for file in sorted((tree / group).glob("*.yaml"))}
    return dict(sorted(files.items()))


OPTIONS = (
    (
        "--help [GROUP | GROUP=NAME …]",
        "this text; the files of a group; the keys under these choices",
    ),
    ("--cfg job", "print the whole configuration and run nothing"),
    ("--config-dir DIR", "search YAML files of your own too"),
    ("--multirun", "run once for each of several choices: model=framesamp_modul,tokendrop_modul"),
)
WIDEST, UNKNOWN_WIDTH = 120, 100  # Columns at most; columns where there is no terminal
SelectGroups = Callable[[Sequence[str]], dict[str, str]]
"""From the words of a command line to the file that each group then takes."""


def help_page(
    config_name: str, words: Sequence[str], trees: Sequence[Path], select: SelectGroups
) -> str:
    """The text of `--help`.

    config_name: the command's file. words: what stands beside `--help`: names of groups, and
    overrides. trees: folders of YAML files, the library's first. select: composes.
    """
    file = next(
        tree / f"{config_name}.yaml" for tree in trees if (tree / f"{config_name}.yaml").is_file()
    )
    overrides = [word for word in words if "=" in word]
    named = [word for word in words if "=" not in word]
    groups = select(overrides)
    for word in named:
        if word not in groups:
            raise UserError(f"{word!r} is no group of this command. {did_you_mean(word, groups)}")
    if named:
        return "\n".join(
            line
            for group in named
            for lines in (
                [f"Group {group}, by default {group}={groups[group]}", ""],
                *(_file(group, name, trees) for name in choices(trees, group)),
            )
            for line in lines
        )
    command = configured_commands().get(config_name, f"python {Path(sys.argv[0]).name}")
    examples, text = heading(file)
    lines = [f"Usage: {command} [KEY=VALUE | GROUP=NAME] …", "", *_wrapped(text), ""]
    lines += ["Examples", *(f"  {example}" for example in examples), ""] if examples else []
    for part in [file, *_included(file, trees)]:
        rows = [key for key in keys(part) if key.default or key.comment]
        if rows:
            of = "" if part == file else f" of {configured_commands().get(part.stem, part.stem)}"
            lines += [f"Keys{of}", *_table([(_assigned(key), key.comment) for key in rows]), ""]
    lines += _group_pages(groups, {word.partition("=")[0] for word in overrides}, trees)
    lines += ["Options", *_table(OPTIONS)]
    return "\n".join(lines)


def _included(file: Path, trees: Sequence[Path]) -> list[Path]:
    """The files of the top level that a command's file is built on, theirs included."""
    files: list[Path] = []
    for name in defaults(file).files:
        part = next(
            (tree / f"{name}.yaml" for tree in trees if (tree / f"{name}.yaml").is_file()), None
        )
        if part is not None:
            files += [part, *_included(part, trees)]
    return files


def _group_pages(groups: dict[str, str], requested: set[str], trees: Sequence[Path]) -> list[str]:
    """Each group with its choices; of those that were asked for (a model means its parts) the keys
    too.
    """
    if not groups:
        return []
    rows = [
        (f"{group}={name}", " · ".join(choices(trees, group)) or "(none)")
        for group, name in sorted(groups.items())
    ]
    lines = [
        "Groups: GROUP=NAME takes another file; --help GROUP shows what is in them",
        *_table(rows),
        "",
    ]
    displayed = {"model", "memory", "integration"} if "model" in requested else set()
    for group in sorted((requested | displayed) & groups.keys()):
        lines += _file(group, groups[group], trees)
    return lines


def _file(group: str, name: str, trees: Sequence[Path]) -> list[str]:
    file = choices(trees, group).get(name)
    if file is None:  # null, or several
        return []
    text = heading(file)[1]
    local_keys = [key for key in explained(file) if key.default or key.comment]
    rows = [(f"{package(file, group)}{_assigned(key)}", key.comment) for key in local_keys]
    taken = [f"{part.strip('/')}={choice}" for part, choice in defaults(file).groups.items()]
    lines = [f"{group}={name}", *_wrapped(text, "  ")]
    lines += [f"  takes {' '.join(taken)}"] if taken else []
    return [*lines, *_table(rows), ""]


def _assigned(key: Key) -> str:
    """A key as it is typed; a section, which has no value of its own, with a colon."""
    return f"{key.name}={key.default}" if key.default else f"{key.name}:"


def _width() -> int:
    return min(shutil.get_terminal_size((UNKNOWN_WIDTH, 24)).columns, WIDEST)


def _wrapped(text: str, indent: str = "") -> list[str]:
    return textwrap.wrap(
        text,
        _width(),
        initial_indent=indent,
        subsequent_indent=indent,
        break_on_hyphens=False,
        break_long_words=False,
    )


def _table(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Two columns; a long first one has a line of its own, so that the second is never squeezed."""
    first = min(max((len(left) for left, _ in rows), default=0), 34)
    lines = []
    for left, right in rows:
        remaining = textwrap.wrap(
            right, max(_width() - first - 4, 30), break_on_hyphens=False, break_long_words=False
        ) or [""]
        if len(left) > first:
            lines.append(f"  {left}")
        else:
            lines.append(f"  {left:<{first}}  {remaining.pop(0)}".rstrip())
        lines += [f"{'':<{first + 4}}{line}" for line in remaining if line]
    return lines


def unknown_option(option: str, words: Sequence[str], paths: Sequence[str]) -> UserError:
    """What to type instead of an option that there is not: settings are `key=value` words here.

    option: as it was typed, `--steps` or `--steps=10`. words: the command line. paths: dotted keys
    of the configuration.
    """
    name, _, value = option.lstrip("-").partition("=")
    after = words[words.index(option) + 1 :][:1] if option in words else []
    value = value or "".join(word for word in after if "=" not in word and not word.startswith("-"))
    near = near_keys(name.replace("-", "_"), paths)
    words = " or ".join(f"{key}={value or '…'}" for key in near)
    hint = f"write {words}." if near else "--help lists them."
    return UserError(
        f"There is no option {option!r}. Settings are words of the form key=value, without dashes:"
        f" {hint}"
    )


def near_keys(name: str, paths: Sequence[str], most: int = 3) -> list[str]:
    """The dotted keys that `name` may mean: those that end in it, then those it is a word of, then
    the like ones.
    """
    last = {path: path.rpartition(".")[2] for path in paths}
    word = name.rpartition(".")[2]
    equal = [path for path in paths if path == name or last[path] == word]
    parts = [path for path in paths if word in last[path].split("_")]
    like = [
        path
        for near in difflib.get_close_matches(word, set(last.values()))
        for path in paths
        if last[path] == near
    ]
    return list(dict.fromkeys(equal or parts or like))[:most]


def argument_parser(
    command: str, text: str | None, examples: Sequence[str]
) -> argparse.ArgumentParser:
    """A parser for commands that read options instead of a configuration, with the same kind of
    `--help`.

    command: as it is typed. text: what it does. examples: what is typed after it.
    """
    listed = "\n".join(f"  {command} {example}".rstrip() for example in examples)
    return argparse.ArgumentParser(
        command,
        description=text,
        epilog=f"Examples\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
