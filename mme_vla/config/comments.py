"""What the comments in the YAML files say: read once for `--help` and for docs/configuration.md."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

COMMANDS = {
    "train": "python -m mme_vla.train",
    "policy": "build_policy(…)",
    "convert": "python -m mme_vla.data.convert",
    "exec_starts": "python -m mme_vla.data.exec_starts",
    "cache": "python -m mme_vla.data.cache",
    "inspect": "python -m mme_vla.inspect",
    "serve": "python -m mme_vla.serve",
    "record": "python -m mme_vla.envs.record",
    "show": "python -m mme_vla.envs.show",
    "play": "python -m mme_vla.play",
    "nano": "python -m mme_vla.nano",
    "vision_pretrain": "python -m mme_vla.nano.vision_pretrain",
    "evaluate": "python -m mme_vla.evaluate",
    "probe": "python -m mme_vla.probe",
    "subgoal_build": "python -m mme_vla.subgoal.build",
    "subgoal_train": "python -m mme_vla.subgoal.train",
}
"""Which command a file of the tree's top level configures."""
_KEY = re.compile(r"^(?P<indent> *(?:- )?)(?P<key>[\w/]+):(?: +(?P<value>[^#]*?))?(?: +# (?P<comment>.*))?$")
_PACKAGE = "# @package"


@dataclass(frozen=True)
class Key:
    """One key of a file. name: dotted, within the file. default, comment: as they are written; empty where not."""

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
    found: list[Key] = []
    path: list[str] = []
    for line in file.read_text().splitlines():
        match = _KEY.match(line)
        if not match:
            continue
        depth = len(match["indent"]) // 2
        path = [*path[:depth], match["key"]]
        if path[0] not in ("defaults", "hydra"):
            found.append(Key(".".join(path), (match["value"] or "").strip(), match["comment"] or ""))
    return found


def explained(file: Path) -> list[Key]:
    """`keys`, with what another file of the group says of a key where this one says nothing."""
    own = keys(file)
    if all(key.comment for key in own):
        return own
    said = {key.name: key.comment for other in sorted(file.parent.glob("*.yaml")) for key in keys(other) if key.comment}
    return [Key(key.name, key.default, key.comment or said.get(key.name, "")) for key in own]


def heading(file: Path) -> tuple[list[str], str]:
    """The comment that a file begins with: example commands, and the text after them as one paragraph."""
    lines: list[str] = []
    for line in file.read_text().splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith(_PACKAGE):
            lines.append(line.lstrip("# "))
    examples = [line for line in lines if line.startswith("python -m ")]
    return examples, " ".join(line for line in lines if line not in examples)


def package(file: Path, group: str) -> str:
    """The section that a group's file fills, with a dot behind it; empty where it fills the top level."""
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
    return Defaults(files, {group: name for group, name in groups.items() if not group.startswith("override ")})


def choices(trees: Iterable[Path], group: str) -> dict[str, Path]:
    """The files of a group by name, of all trees; a later tree's file stands before an earlier one's."""
    found = {file.stem: file for tree in trees for file in sorted((tree / group).glob("*.yaml"))}
    return dict(sorted(found.items()))
