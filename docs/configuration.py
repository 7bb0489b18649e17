"""Writes docs/configuration.md from the YAML files and their comments: `python docs/configuration.py`."""

from pathlib import Path

from mme_vla.cli.help import COMMANDS, heading, keys

ROOT = Path(__file__).resolve().parent.parent
CONFIGS, PAGE = ROOT / "configs", ROOT / "docs" / "configuration.md"
INTRODUCTION = """# Configuration

Written by `python docs/configuration.py` from the comments in [`configs/`](../configs); a test keeps the two equal.

Every command takes `key=value` and `group=file` words: `python -m mme_vla.train model=framesamp_modul train.lr=1e-3`.
`--help` explains the keys, `--help memory` the files of a group, `--help model=tokendrop_expert` the keys under these
choices. `--cfg job` prints the whole configuration and runs nothing, `--config-dir DIR` adds YAML files of your own,
`--multirun` sweeps (`model=framesamp_modul,tokendrop_modul`). A misspelt key is answered with the near ones. In Python
the same words are keyword arguments: `build_policy("framesamp_modul", backbone="pi05", memory={"budget": 256})`.
"""


def prose(text: str) -> str:
    """Text of a comment as Markdown: what is in angle brackets is no tag, a bar is no column."""
    pieces = text.split("`")  # every second one is in backticks, where only a bar means anything
    for i, piece in enumerate(pieces):
        bare = piece if i % 2 else piece.replace("<", "&lt;").replace(">", "&gt;").replace("*", r"\*")
        pieces[i] = bare.replace("|", r"\|")
    return "`".join(pieces)


def code(text: str) -> str:
    """Text in backticks within a table, where a bar would end the cell."""
    return f"`{text.replace('|', chr(92) + '|')}`" if text else ""


def section(file: Path, title: str) -> str:
    """One file as a heading, its introduction, example commands and a table of its keys."""
    examples, text = heading(file)
    parts = [title, prose(text)]
    if examples:
        parts.append("\n".join(["```bash", *examples, "```"]))
    rows = keys(file)
    if rows:
        lines = ["| key | default | |", "|---|---|---|"]
        lines += [f"| {code(key.name)} | {code(key.default)} | {prose(key.comment)} |" for key in rows]
        parts.append("\n".join(lines))
    return "\n\n".join(part for part in parts if part)


def page() -> str:
    """The whole page."""
    parts = [INTRODUCTION.strip(), "## Commands"]
    for file in sorted(CONFIGS.glob("*.yaml")):
        link = f"[{file.name}](../configs/{file.name})"
        parts.append(section(file, f"### `{COMMANDS.get(file.stem, file.stem)}` ({link})"))
    for group in sorted(folder for folder in CONFIGS.iterdir() if folder.is_dir()):
        files = sorted(group.glob("*.yaml"))
        parts.append(f"## Group `{group.name}`")
        if group.name == "model":
            parts.append("One file a variant: a memory and an integration. " + " · ".join(f"`{f.stem}`" for f in files))
            continue
        for file in files:
            where = f"../configs/{group.name}/{file.name}"
            parts.append(section(file, f"### `{group.name}={file.stem}` ([file]({where}))"))
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
