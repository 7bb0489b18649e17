"""The pages of the configuration, from the YAML files and their comments."""

import re
from dataclasses import dataclass
from os.path import relpath
from pathlib import Path

from mme_vla.cli.help import heading
from mme_vla.config.trees import library_files, library_trees

REPOSITORY = Path(__file__).resolve().parents[2]
INTRODUCTION = """# Configuration

Every command takes `key=value` and `group=file` words: `mme-vla train model=framesamp_modul train.lr=1e-3`.
The keys of a command are on its page under *Commands*, the files of a group below. In Python the same words are keyword
arguments: `build_policy("framesamp_modul", backbone="pi05", memory={"budget": 256})`.

| option | |
|---|---|
| `--help` | the keys of the command |
| `--help memory` | the files of a group |
| `--help model=tokendrop_expert` | the keys under these choices |
| `--cfg job` | print the whole configuration and run nothing |
| `--config-dir DIR` | search YAML files of your own too |
| `--multirun` | run once for each choice: `model=framesamp_modul,tokendrop_modul` |

A misspelt key is an error that names the nearest keys.
"""  # noqa: E501

UNBROKEN = 24
"""Characters of a default that is never broken into lines."""
_KEY = re.compile(
    r"^(?P<indent> *(?:- )?)(?P<key>[\w/]+):(?: +(?P<value>[^#]*?))?(?: +# (?P<comment>.*))?$"
)


@dataclass(frozen=True)
class Key:
    """One key of a file. name: dotted, within the file. default, comment: as they are written;
    empty where not.
    """

    name: str
    default: str
    comment: str


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


MARKUP = {"<": "&lt;", ">": "&gt;", "*": r"\*", "[": r"\[", "{": "&#123;", "}": "&#125;"}
"""Characters of a comment that mean something in Markdown or its extension for attributes."""
PAGE = re.compile(r"docs/([\w/-]+\.md)(#[\w-]+)?")


def prose(text: str, folder: str = "reference/commands") -> str:
    """Text of a comment as Markdown: what is in angle brackets is no tag, a bar is no column, a
    page of the documentation is a link.

    Args:
        text: the comment.
        folder: of the page that shows it, under `docs/`.
    """
    pieces = text.split("`")  # every second one is in backticks, where only a bar means anything
    for i, piece in enumerate(pieces):
        if i % 2 == 0:
            for character, entity in MARKUP.items():
                piece = piece.replace(character, entity)
            piece = PAGE.sub(lambda match: page_link(match[1], match[2] or "", folder), piece)
        pieces[i] = piece.replace("|", r"\|")
    return "`".join(pieces)


def page_link(page: str, anchor: str, folder: str) -> str:
    """A link with the page's title; the path as it is where there is no such page."""
    file = REPOSITORY / "docs" / page
    if not file.is_file():
        return f"docs/{page}{anchor}"
    title = file.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ").replace("`", "")
    return f"[{title}]({relpath(page, folder)}{anchor})"


def code(text: str) -> str:
    """Text in backticks within a table, where a bar would end the cell. A value that is computed
    is named: `outputs/<name>/<now>`, and `$NAME` for a variable of the environment.
    """
    text = re.sub(r"\$\{oc\.env:(\w+)[^}]*\}", r"$\1", text)
    text = re.sub(r"\$\{([\w.]+)(?::[^}]*)?\}", r"<\1>", text)
    return f"`{text.replace('|', chr(92) + '|')}`" if text else ""


def introduction(file: Path, folder: str = "reference/commands") -> str:
    """The comment that a file begins with: text and example commands."""
    examples, text = heading(file)
    blocks = ["\n".join(["```bash", *examples, "```"])] if examples else []
    return "\n\n".join([*([prose(text, folder)] if text else []), *blocks])


def key_table(file: Path, folder: str = "reference/commands") -> str:
    """A file's keys with their defaults and comments; empty where it has none."""
    rows = []
    for key in keys(file):
        default = code(key.default)
        if 0 < len(key.default) <= UNBROKEN:
            default += "{ .value }"  # docs/stylesheets/site.css keeps it on one line
        rows.append(f"| {code(key.name)} | {default} | {prose(key.comment, folder)} |")
    return "\n".join(["| key | default | |", "|---|---|---|", *rows]) if rows else ""


def section(file: Path, title: str, folder: str) -> str:
    """One file as a heading, its introduction and its keys."""
    parts = (title, introduction(file, folder), key_table(file, folder))
    return "\n\n".join(part for part in parts if part)


def groups() -> list[str]:
    """The groups of files to choose from, of the core and of the extras."""
    return sorted(
        {folder.name for tree in library_trees() for folder in tree.iterdir() if folder.is_dir()}
    )


def source_link(file: Path) -> str:
    """The address of a file of the repository from a page of a group or command."""
    return f"../../../{file.relative_to(REPOSITORY)}"


def overview() -> str:
    """Introduction, and a table of the groups with their files."""
    files = {group: " · ".join(f"`{name}`" for name in library_files(group)) for group in groups()}
    rows = [f"| [`{name}`](configuration/{name}.md) | {stems} |" for name, stems in files.items()]
    policy = section(library_files("")["policy"], "## `build_policy`", "reference")
    server = section(library_files("")["server"], "## `server`", "reference")
    return "\n\n".join(
        [
            INTRODUCTION.strip(),
            "## Groups",
            "\n".join(["| group | files |", "|---|---|", *rows]),
            policy,
            server,
        ]
    )


def group_page(group: str) -> str:
    """The files of a group, each with its keys."""
    parts = [
        f"# `{group}`",
        f"`{group}=NAME` takes one of these files. *default* is the file's value.",
    ]
    for file in library_files(group).values():
        title = f"## [`{group}={file.stem}`]({source_link(file)})"
        parts.append(section(file, title, "reference/configuration"))
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Path under `docs/` → Markdown: the overview, and a page for each group."""
    named = {f"reference/configuration/{group}.md": group_page(group) for group in groups()}
    return {"reference/configuration.md": overview(), **named}
