"""The name of a composition, found among the models of the tree it is composed from."""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf

# The memory that several memories make (`mme_vla.memory.joined`, configs/memory/joined.yaml)
JOINED = "joined"
DEFAULT_BUDGET = 512
"""Memory tokens of a policy that sets no budget, as in the paper."""

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
    """Overrides in which `memory=[framesamp,ttt]` is written out: the memory `joined` with these
    members.

    Hydra itself would lay the two files over each other.
    """
    result: list[str] = []
    for word in overrides:
        several = _SEVERAL.fullmatch(word)
        result += [f"memory={JOINED}", f"memory.members={several[1]}"] if several else [word]
    return result


def join_memories(cfg: DictConfig) -> DictConfig:
    """A configuration in which a list of memories, as a file may give it
    (`memory: [framesamp, ttt]`), is one memory.

    Changed in place, and returned.
    """
    if isinstance(cfg.get("memory"), ListConfig):
        members = OmegaConf.to_container(cfg.memory, resolve=True)
        cfg.memory = {"name": JOINED, "budget": DEFAULT_BUDGET, "members": members}
    return cfg


DECISIVE = ("memory", "integration", "processor", "subgoal_text", "token_budget")
"""Sections that make one variant another; the backbone's size and the training do not."""
FREE = (
    "memory.budget",
    "processor.tokenizer",
    "processor.text",
    "processor.side",
    "processor.max_words",
)
"""Keys in them that do not: a budget has a field of its own in records; pixels and words go with
the backbone.
"""
POLICY, DEFAULT_POLICY = "policy.name", "mme"
LONGEST = 32  # Letters that differences may take in a name; more are a digest

Sections = dict[str, Any]  # Flat dotted keys of the decisive sections, those that are set
Reference = Callable[[str], tuple[str, Sections] | None]
"""From the file name of a model to its name and sections; None where it cannot be composed."""


def decisive(cfg: DictConfig) -> Sections:
    """The keys of a composed configuration that make it the variant it is."""
    values: Sections = {}
    for key in DECISIVE:
        if key in cfg:
            value = cfg[key]
            container = (
                OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            )
            values |= flat({key: container})
    if "policy" in cfg:
        values |= of_policy(cfg.policy)
    return {key: value for key, value in values.items() if value is not None and key not in FREE}


def may_be_of(model: Path, sections: Sections) -> bool:
    """Whether a model may compose to this memory and integration: reads its files, where composing
    takes 60 ms.
    """
    described = _read(model)
    if not isinstance(described, dict):
        return True
    return all(
        _may_choose(model.parent.parent, described, part, sections)
        for part in ("memory", "integration")
    )


def _may_choose(tree: Path, described: dict[Any, Any], part: str, sections: Sections) -> bool:
    if "name" in (described.get(part) or {}):
        return True
    choices = [
        one[f"/{part}"]
        for one in described.get("defaults") or ()
        if isinstance(one, dict) and f"/{part}" in one
    ]
    file = tree / part / f"{choices[0]}.yaml" if choices else None
    if file is None or not file.is_file():
        return True
    name = _read(file)
    return not isinstance(name, dict) or name.get("name") == sections.get(f"{part}.name")


def _read(file: Path) -> Any:
    return _parsed(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _parsed(file: Path, changed: int) -> Any:
    """A YAML file as it was when it was last changed; a name with differences compares
    all models.
    """
    return OmegaConf.to_container(OmegaConf.load(file))


def variant_name(
    name_in_config: str,
    sections: Sections,
    models: Iterable[str],
    reference: Reference,
    parts: Callable[[], Sections | None],
) -> str:
    """The name of a composition.

    Args:
        name_in_config: what the chosen model's file calls it. sections: `decisive` of the
            composition.
        models: the files of the group `model`. reference: what each of them composes to; None also
            where it cannot be a composition of the same parts.
        parts: what the memory and the integration compose to with no value changed; None where that
            is not known.

    Returns:
        `name_in_config` if the user chose a name that is no model's, or if it is true; else the
        name of the model that equals the composition; else that of the nearest model with the same
        parts (or the parts' names) with the differences.
    """
    names = sorted(models)
    if name_in_config not in names:
        return name_in_config
    base_variant = reference(name_in_config)
    if base_variant is not None and base_variant[1] == sections:
        return base_variant[0]
    known = [variant for variant in map(reference, names) if variant is not None]
    for name, known_sections in known:
        if known_sections == sections:
            return name
    alike = [variant for variant in known if _kind(variant[1]) == _kind(sections)]
    if alike:
        name, base = min(
            alike,
            key=lambda variant: (
                variant[0] != name_in_config,
                len(_differences(variant[1], sections)),
            ),
        )
        return f"{name}-{_suffix(_differences(base, sections))}"
    name = (
        "_".join(part for part in (sections.get(POLICY, ""), *_parts(sections)) if part)
        or "memoryless"
    )
    part_sections = parts()
    if part_sections == sections:
        return name
    differences = _differences(part_sections or {}, sections)
    return f"{name}-{_suffix(differences, words=part_sections is not None)}"


def _parts(sections: Sections) -> tuple[str, str]:
    members = sections.get("memory.members")
    joined = [str(m.get("name") if isinstance(m, Mapping) else m) for m in members or ()]
    return "_".join(joined) or str(sections.get("memory.name", "")), str(
        sections.get("integration.name", "")
    )


def _kind(sections: Sections) -> tuple[str, ...]:
    return (str(sections.get(POLICY, "")), *_parts(sections))


def of_policy(section: Mapping[str, Any]) -> Sections:
    """The kind of policy, where it is not the usual one, which configurations did not
    use to name.
    """
    name = section.get("name", DEFAULT_POLICY)
    return {} if name == DEFAULT_POLICY else {POLICY: name}


def _differences(base: Sections, sections: Sections) -> Sections:
    keys = sorted(base.keys() | sections.keys())
    return {key: sections.get(key) for key in keys if base.get(key) != sections.get(key)}


def _suffix(differences: Sections, words: bool = True) -> str:
    """The differences spelt out where these are short, else a digest of them."""
    text = "-".join(
        f"{key.rpartition('.')[2]}_{_word(value)}" for key, value in differences.items()
    )
    return text if words and len(text) <= LONGEST else digest(differences, 6)


def _word(value: Any) -> str:
    text = (
        "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    )
    return re.sub(r"[^\w.]+", "_", text).strip("_.")


def digest(values: Mapping[str, Any], letters: int) -> str:
    """So many letters that are equal for equal values, whatever their order."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:letters]


def flat(values: Mapping[str, Any], prefix: str = "") -> Sections:
    """Nested sections as one, under dotted keys."""
    result: Sections = {}
    for key, value in values.items():
        result |= (
            flat(value, f"{prefix}{key}.")
            if isinstance(value, Mapping)
            else {f"{prefix}{key}": value}
        )
    return result
