"""The pages of the configuration, from the YAML files and their comments."""

from pathlib import Path

from mme_vla.cli.help import heading, keys

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
INTRODUCTION = """# Configuration

Every command takes `key=value` and `group=file` words: `python -m mme_vla.train model=framesamp_modul train.lr=1e-3`.
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


def prose(text: str) -> str:
    """Text of a comment as Markdown: what is in angle brackets is no tag, a bar is no column."""
    pieces = text.split("`")  # every second one is in backticks, where only a bar means anything
    for i, piece in enumerate(pieces):
        bare = (
            piece if i % 2 else piece.replace("<", "&lt;").replace(">", "&gt;").replace("*", r"\*")
        )
        pieces[i] = bare.replace("|", r"\|")
    return "`".join(pieces)


def code(text: str) -> str:
    """Text in backticks within a table, where a bar would end the cell."""
    return f"`{text.replace('|', chr(92) + '|')}`" if text else ""


def introduction(file: Path) -> str:
    """The comment that a file begins with: text and example commands."""
    examples, text = heading(file)
    blocks = ["\n".join(["```bash", *examples, "```"])] if examples else []
    return "\n\n".join([*([prose(text)] if text else []), *blocks])


def key_table(file: Path) -> str:
    """A file's keys with their defaults and comments; empty where it has none."""
    rows = [
        f"| {code(key.name)} | {code(key.default)} | {prose(key.comment)} |" for key in keys(file)
    ]
    return "\n".join(["| key | default | |", "|---|---|---|", *rows]) if rows else ""


def section(file: Path, title: str) -> str:
    """One file as a heading, its introduction and its keys."""
    return "\n\n".join(part for part in (title, introduction(file), key_table(file)) if part)


def groups() -> list[Path]:
    """The folders of files to choose from."""
    return sorted(folder for folder in CONFIGS.iterdir() if folder.is_dir())


def overview() -> str:
    """Introduction, and a table of the groups with their files."""
    files = {
        group.name: " · ".join(f"`{file.stem}`" for file in files_of(group)) for group in groups()
    }
    rows = [f"| [`{name}`](configuration/{name}.md) | {stems} |" for name, stems in files.items()]
    policy = section(CONFIGS / "policy.yaml", "## `build_policy`")
    return "\n\n".join(
        [
            INTRODUCTION.strip(),
            "## Groups",
            "\n".join(["| group | files |", "|---|---|", *rows]),
            policy,
        ]
    )


def files_of(group: Path) -> list[Path]:
    return sorted(group.glob("*.yaml"))


def group_page(group: Path) -> str:
    """The files of a group, each with its keys."""
    parts = [
        f"# `{group.name}`",
        f"`{group.name}=NAME` takes one of these files. *default* is the file's value.",
    ]
    for file in files_of(group):
        title = f"## [`{group.name}={file.stem}`](../../../configs/{group.name}/{file.name})"
        parts.append(section(file, title))
    return "\n\n".join(parts) + "\n"


def pages() -> dict[str, str]:
    """Path under `docs/` → Markdown: the overview, and a page for each group."""
    named = {f"reference/configuration/{group.name}.md": group_page(group) for group in groups()}
    return {"reference/configuration.md": overview(), **named}
