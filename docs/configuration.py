"""Writes docs/configuration.md from the YAML files and their comments: `python docs/configuration.py`."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CONFIGS, PAGE = ROOT / "configs", ROOT / "docs" / "configuration.md"
KEY = re.compile(r"^(?P<indent> *(?:- )?)(?P<key>[\w/]+):(?: +(?P<value>[^#]*?))?(?: +# (?P<comment>.*))?$")
COMMANDS = {
    "train": "python -m mme_vla.train",
    "policy": "build_policy(…)",
    "convert": "python -m mme_vla.data.convert",
    "cache": "python -m mme_vla.data.cache",
    "inspect": "python -m mme_vla.inspect",
    "serve": "python -m mme_vla.serve",
    "evaluate": "python -m mme_vla.evaluate",
    "record": "python -m mme_vla.envs.record",
    "show": "python -m mme_vla.envs.show",
    "play": "python -m mme_vla.play",
    "subgoal_build": "python -m mme_vla.subgoal.build",
    "subgoal_train": "python -m mme_vla.subgoal.train",
}
INTRODUCTION = """# Configuration

Written by `python docs/configuration.py` from the comments in [`configs/`](../configs); a test keeps the two equal.

Every command takes `key=value` and `group=file` words: `python -m mme_vla.train model=framesamp_modul train.lr=1e-3`.
`--cfg job` prints the whole configuration and runs nothing, `--help` lists the groups, `--config-dir DIR` adds YAML
files of your own, `--multirun` sweeps (`model=framesamp_modul,tokendrop_modul`). A misspelt key is answered with the
near ones. In Python the same words are keyword arguments:
`build_policy("framesamp_modul", backbone="pi05", memory={"budget": 256})`.
"""


def keys(file: Path) -> list[tuple[str, str, str]]:
    """(dotted key, default, comment) of every key in a YAML file; what follows `defaults:` is left out."""
    found, path = [], []
    for line in file.read_text().splitlines():
        match = KEY.match(line)
        if not match:
            continue
        depth = len(match["indent"]) // 2
        path = [*path[:depth], match["key"]]
        if path[0] in ("defaults", "hydra"):
            continue
        found.append((".".join(path), (match["value"] or "").strip(), match["comment"] or ""))
    return found


def heading(file: Path) -> list[str]:
    """The comment lines a file begins with."""
    lines = []
    for line in file.read_text().splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            lines.append(line.lstrip("# "))
    return lines


def section(file: Path, title: str) -> str:
    """One file as a heading, its introduction and a table of its keys."""
    parts = [title, " ".join(heading(file))]
    rows = keys(file)
    if rows:
        lines = ["| key | default | |", "|---|---|---|"]
        lines += [f"| `{key}` | {f'`{value}`' if value else ''} | {comment} |" for key, value, comment in rows]
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
