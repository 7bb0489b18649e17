"""Words of overrides, lists of memories, and the digest of what makes one variant another."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

# The memory that several memories make (`mme_vla.memory.joined`, configs/memory/joined.yaml)
JOINED = "joined"
DEFAULT_BUDGET = 512
"""Memory tokens of a policy that sets no budget, as in the paper."""

_UNQUOTED = re.compile(r"[\w:=,./-]+")  # no quote or bracket; with the commas of a sweep
_DIAL = re.compile(r"[\w:]+:\w+=\d+")
_SEVERAL = re.compile(r"/?memory=(\[.*\])")


def words(key: str, value: Any) -> list[str]:
    """Write a keyword argument as overrides."""
    if not isinstance(value, Mapping):
        return [f"{key}={literal(value)}"]
    result: list[str] = []
    for name, inner in value.items():
        result += words(f"{key}.{name}", inner)
    return result


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


def expand_overrides(overrides: Iterable[str]) -> list[str]:
    """Overrides as Hydra reads them.

    `memory=[framesamp,ttt]` is written out as the memory `joined` with these members: Hydra itself
    would lay the two files over each other. The value of `split=stress:count=2` is quoted, since it
    has a `=`.
    """
    result: list[str] = []
    for word in overrides:
        several = _SEVERAL.fullmatch(word)
        key, _, value = word.partition("=")
        if several:
            result += [f"memory={JOINED}", f"memory.members={several[1]}"]
        elif _UNQUOTED.fullmatch(value):
            quoted = _DIAL.sub(r"'\g<0>'", value)
            result.append(f"{key}={quoted}")
        else:
            result.append(word)
    return result


DEFAULT_MODEL = "tokendrop_expert"
"""The model of configs/policy.yaml."""


def name_composition(cfg: DictConfig, overrides: Iterable[str]) -> None:
    """Make a list of memories, as a file may give it (`memory: [framesamp, ttt]`), one memory, and
    give a configuration whose memory or integration the command line chose without a model a name
    of its own, such as `rmt_modulator`: the default model is another one.
    """
    if isinstance(cfg.get("memory"), ListConfig):
        members = OmegaConf.to_container(cfg.memory, resolve=True)
        cfg.memory = {"name": JOINED, "budget": DEFAULT_BUDGET, "members": members}
    keys = {word.lstrip("+").partition("=")[0] for word in overrides}
    has_parts = bool(keys & {"memory", "memory.name", "integration", "integration.name"})
    if not has_parts or keys & {"model", "name"} or "name" not in cfg or cfg.name != DEFAULT_MODEL:
        return
    memory = cfg.memory or {}
    names = []
    for member in memory.get("members") or [memory]:
        names.append(member.get("name") if isinstance(member, Mapping) else member)
    parts = ["+".join(map(str, filter(None, names))), (cfg.integration or {}).get("name")]
    cfg.name = "_".join(map(str, filter(None, parts))) or "memoryless"


DECISIVE = ("memory", "integration", "processor", "subgoal_text", "token_budget")
"""Sections that make one variant another; the backbone's size and the training do not."""


def digest(values: Mapping[str, Any], letters: int) -> str:
    """So many letters that are equal for equal values, whatever their order."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:letters]


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested sections as one, under dotted keys."""
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            result |= flat(value, f"{prefix}{key}.")
        else:
            result[f"{prefix}{key}"] = value
    return result
