"""Hydra's grammar, written: Python values as the words of a command line, and a list of memories as one memory."""

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

JOINED = "joined"
"""The memory that several memories make (`mme_vla.memory.joined`, configs/memory/joined.yaml)."""
BUDGET = 512
"""Memory tokens of a policy unless it says otherwise, as in the paper."""

_SEVERAL = re.compile(r"/?memory=(\[.*\])")


def words(key: str, value: Any) -> list[str]:
    """Write a keyword argument as overrides."""
    if isinstance(value, Mapping):
        return [word for inner, v in value.items() for word in words(f"{key}.{inner}", v)]
    return [f"{key}={literal(value)}"]


def literal(value: Any) -> str:
    """Write a value in Hydra's grammar; what is not a plain word is quoted."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(literal, value))}]"
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}:{literal(inner)}" for key, inner in value.items()) + "}"
    text = str(value)
    if isinstance(value, int | float) or re.fullmatch(r"[\w./:~+-]+", text):
        return text
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"


def several_memories(overrides: Iterable[str]) -> list[str]:
    """Overrides in which `memory=[framesamp,ttt]` is written out: the memory `joined` with these members.

    Hydra itself would lay the two files over each other.
    """

    def written(word: str) -> Iterator[str]:
        several = _SEVERAL.fullmatch(word)
        yield from [f"memory={JOINED}", f"memory.members={several[1]}"] if several else [word]

    return [new for word in overrides for new in written(word)]


def join_memories(cfg: DictConfig) -> DictConfig:
    """A configuration in which a list of memories, as a file may give it (`memory: [framesamp, ttt]`), is one memory.

    Changed in place, and returned.
    """
    if isinstance(cfg.get("memory"), ListConfig):
        members = OmegaConf.to_container(cfg.memory, resolve=True)
        cfg.memory = {"name": JOINED, "budget": BUDGET, "members": members}
    return cfg
