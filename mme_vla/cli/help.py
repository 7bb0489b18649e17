"""The text of `--help`: what a command does, examples, and the commented YAML files themselves.

`--help` alone prints the command's own files and the groups with their choices, `--help memory` the
files of a group, `--help model=framesamp_modul` one of them. Nothing here imports PyTorch.
"""

import argparse
import re
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import yaml

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.table import commands
from mme_vla.config.trees import yaml_files
from mme_vla.errors import UserError, did_you_mean


def configured_commands() -> dict[str, str]:
    """File of the tree's top level → how the command that it configures is typed."""
    # Files that commands include.
    usages = {"policy": "build_policy(…)", "server": "RemotePolicy(…)"}
    for name, command in commands().items():
        if command.config:
            usages[command.config] = f"mme-vla {name}"
    return usages


_PACKAGE = "# @package"


@dataclass(frozen=True)
class Defaults:
    """The list a file begins with. files: of the top level. groups: group → the file chosen."""

    files: Sequence[str]
    groups: dict[str, str]


def heading(file: Path) -> tuple[list[str], str]:
    """The comment that a file begins with: example commands, and the text after them as one
    paragraph.
    """
    examples: list[str] = []
    text: list[str] = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            break
        words = line.lstrip("# ")
        if words.startswith(("python -m ", "mme-vla ")):
            examples.append(words)
        elif not line.startswith(_PACKAGE):
            text.append(words)
    return examples, " ".join(text)


def defaults(file: Path) -> Defaults:
    """What a file is composed of; overrides of Hydra's own groups are left out."""
    content = yaml.safe_load(file.read_text(encoding="utf-8")) or {}
    listed: list[Any] = content.get("defaults", []) if isinstance(content, dict) else []
    files = []
    groups = {}
    for entry in listed:
        if isinstance(entry, dict):
            for group, name in entry.items():
                if not str(group).startswith("override "):
                    groups[str(group)] = "null" if name is None else str(name)
        elif isinstance(entry, str) and entry != "_self_":
            files.append(entry)
    return Defaults(files, groups)


OPTIONS = """\
  --help [GROUP | GROUP=NAME …]  this text; the files of a group; one of its files
  --cfg job                      print the whole configuration and run nothing
  --config-dir DIR               search YAML files of your own too
  --multirun                     run once for each choice: model=framesamp_modul,tokendrop_modul"""


def help_page(config_name: str, words: Sequence[str], trees: Sequence[Path]) -> str:
    """The text of `--help`.

    Args:
        config_name: the command's file.
        words: what stands beside `--help`: a group, or a group's file (`model=framesamp_modul`).
        trees: folders of YAML files in the order of search.

    Raises:
        UserError: a word is no group of this command, or no file of its group.
    """
    files = _with_included(yaml_files(trees, "")[config_name], trees)
    groups = _groups(files, trees)
    if words:
        return "\n\n".join(_group_page(word, groups, trees) for word in words)
    command = configured_commands().get(config_name, f"python {Path(sys.argv[0]).name}")
    examples, text = heading(files[0])
    parts = [f"Usage: {command} [KEY=VALUE | GROUP=NAME] …", text]
    if examples:
        parts.append("\n".join(["Examples", *(f"  {example}" for example in examples)]))
    for file in files:
        title = "Keys"
        if file != files[0]:
            title = f"Keys of {configured_commands().get(file.stem, file.stem)}"
        parts.append(f"{title}\n{textwrap.indent(_body(file), '  ')}")
    rows = []
    for group, name in sorted(groups.items()):
        rows.append(f"  {group}={name}: {' · '.join(yaml_files(trees, group)) or '(none)'}")
    if rows:
        introduction = "Groups: GROUP=NAME takes another file; --help GROUP shows what is in them"
        parts.append("\n".join([introduction, *rows]))
    parts.append(f"Options\n{OPTIONS}")
    return "\n\n".join(parts)


def _with_included(file: Path, trees: Sequence[Path]) -> list[Path]:
    """A file of the top level, and those that it is built on."""
    files = [file]
    for name in defaults(file).files:
        part = yaml_files(trees, "").get(name)
        if part is not None:
            files += _with_included(part, trees)
    return files


def _groups(files: Sequence[Path], trees: Sequence[Path]) -> dict[str, str]:
    """Group → the file that it takes by default, of these files and of the files that they take."""
    groups: dict[str, str] = {}
    pending = list(files)
    while pending:
        for name, choice in defaults(pending.pop(0)).groups.items():
            group = name.strip("/").partition("@")[0]
            if group not in groups:
                groups[group] = choice
                file = yaml_files(trees, group).get(choice)
                if file is not None:
                    pending.append(file)
    return groups


def _group_page(word: str, groups: dict[str, str], trees: Sequence[Path]) -> str:
    """The files of a group, or the one that `group=name` chooses."""
    group, _, name = word.partition("=")
    if group not in groups:
        raise UserError(f"{group!r} is no group of this command. {did_you_mean(group, groups)}")
    files = yaml_files(trees, group)
    if name and name not in files:
        near = did_you_mean(name, files, f"--help {group}")
        raise UserError(f"Unknown {group} {name!r}. {near}")
    if name:
        files = {name: files[name]}
    parts = [f"Group {group}, by default {group}={groups[group]}"]
    for stem, file in files.items():
        parts.append(
            f"{group}={stem}\n{textwrap.indent(file.read_text(encoding='utf-8').rstrip(), '  ')}"
        )
    return "\n\n".join(parts)


def _body(file: Path) -> str:
    """A file without the comment that it begins with and without Hydra's own sections."""
    lines: list[str] = []
    is_printed = True
    for line in file.read_text(encoding="utf-8").splitlines():
        if line and not line[0].isspace() and not line.startswith("#"):
            is_printed = not line.startswith(("defaults:", "hydra:"))
        if is_printed and (lines or not line.startswith("#")):
            lines.append(line)
    return "\n".join(lines).strip()


class CommandParser(argparse.ArgumentParser):
    """A parser whose replies to mistakes are those of the commands with a configuration.

    A mistake ends the process with code 2 and one sentence that names the word, what is known and
    where more is said.
    """

    _subparser: argparse.ArgumentParser | None = None  # the parser of the subcommand

    def error(self, message: str) -> NoReturn:
        """End with a mistake of a command line."""
        if self._subparser is not None and message.startswith("unrecognized"):
            self._subparser.error(message)  # whose words these are
        with print_user_errors():
            sentence = self._explanation(message).rstrip(".")
            raise UserError(f"{sentence}. `{self.prog} --help` says more.")
        raise AssertionError("a user error ends the process")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            if isinstance(action, argparse._SubParsersAction):
                self._subparser = action.choices[value]
            return
        name = "/".join(action.option_strings) or str(action.metavar or action.dest)
        choices = [str(choice) for choice in action.choices]
        if not action.option_strings and "=" in str(value):
            example = f"{self.prog} {choices[0]} {_as_option(str(value))}"
            self.error(
                f"{value!r} comes too early: {name} is first, one of {', '.join(choices)}. Settings"
                f" are options here. Such as: {example}"
            )
        self.error(f"{name} {value!r} is not known. {did_you_mean(str(value), choices)}")

    def _explanation(self, message: str) -> str:
        """A message of argparse in the words of the other commands."""
        kind, _, detail = message.partition(": ")
        if kind == "unrecognized arguments":
            return self._unknown_word(detail.split()[0])
        if kind == "the following arguments are required":
            names = []
            for action in self._actions:
                word = str(action.metavar or action.dest)
                if word in detail.split(", ") and action.nargs != "*":
                    names.append(word)
            names = names or detail.split(", ")
            return f"A value is needed for {' and '.join(names)}{self._help_of(names[0])}."
        name = kind.removeprefix("argument ")
        if detail.startswith("expected "):
            return f"{name} needs {detail.removeprefix('expected ').replace('argument', 'value')}."
        invalid = re.fullmatch(r"invalid (\w+) value: (.+)", detail, re.DOTALL)
        if invalid:
            expected = _NUMBERS.get(invalid[1], f"of type {invalid[1]}")
            return f"{name} {invalid[2]} does not fit: it is {expected}."
        return f"{message[:1].upper()}{message[1:]}."

    def _unknown_word(self, word: str) -> str:
        options = [name for name in self._option_string_actions if name.startswith("--")]
        typed = word.partition("=")[0]
        if not word.startswith("-") and f"--{typed}" in options:
            return f"{word!r} is written as an option here: {_as_option(word)}."
        what = "There is no option" if word.startswith("-") else "There is no place for the word"
        return f"{what} {typed!r}. {did_you_mean(typed, options)}"

    def _help_of(self, name: str) -> str:
        """What help says of a positional argument."""
        for action in self._actions:
            if name != str(action.metavar or action.dest):
                continue
            if action.choices:
                return f", one of {', '.join(map(str, action.choices))}"
            if action.help:
                return f" ({name}: {action.help})"
        return ""


_NUMBERS = {"int": "a whole number", "float": "a number"}


def _as_option(word: str) -> str:
    """A `key=value` word as an option."""
    key, _, value = word.partition("=")
    return f"--{key} {value or '…'}"


def argument_parser(command: str, text: str | None, examples: Sequence[str]) -> CommandParser:
    """A parser for commands that read options instead of a configuration, with the same kind of
    `--help`.

    command: as it is typed.
    text: what it does.
    examples: what is typed after it.
    """
    listed = "\n".join(f"  {command} {example}".rstrip() for example in examples)
    return CommandParser(
        command,
        description=text,
        epilog=f"Examples\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
