"""What a composition is called.

A model's name stands in folders, cards and records, so it must be true: `memory=framesamp integration=modulator` on
top of another model is `framesamp_modul`, and a composition that no file of `configs/model` describes gets a name of
its own, built from its parts and from what differs (`framesamp_modul-pooling_max`).
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

DECISIVE = ("memory", "integration", "processor", "subgoal_text", "token_budget")
"""Sections that make one variant another; the backbone's size and the training do not."""
FREE = ("memory.budget", "processor.tokenizer", "processor.text", "processor.side")
"""Keys in them that do not: a budget has a field of its own in records; pixels and words go with the backbone."""
POLICY, USUAL_POLICY = "policy.name", "mme"
LONGEST = 32
"""Letters that differences may take in a name; more are a digest."""

Sections = dict[str, Any]
"""Flat dotted keys of the decisive sections, those that are set."""
Reference = Callable[[str], tuple[str, Sections] | None]
"""From the file name of a model to its name and sections; None where it cannot be composed."""


def decisive(cfg: DictConfig) -> Sections:
    """The keys of a composed configuration that make it the variant it is."""
    found: Sections = {}
    for key in DECISIVE:
        if key in cfg:
            value = cfg[key]
            plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
            found |= flat({key: plain})
    if "policy" in cfg:
        found |= of_policy(cfg.policy)
    return {key: value for key, value in found.items() if value is not None and key not in FREE}


def may_be_of(model: Path, sections: Sections) -> bool:
    """Whether a model may compose to this memory and integration: a look at its files, where composing takes 60 ms."""
    described = _read(model)
    if not isinstance(described, dict):
        return True
    return all(_may_choose(model.parent.parent, described, part, sections) for part in ("memory", "integration"))


def _may_choose(tree: Path, described: dict[Any, Any], part: str, sections: Sections) -> bool:
    if "name" in (described.get(part) or {}):
        return True
    chosen = [one[f"/{part}"] for one in described.get("defaults") or () if isinstance(one, dict) and f"/{part}" in one]
    file = tree / part / f"{chosen[0]}.yaml" if chosen else None
    if file is None or not file.is_file():
        return True
    name = _read(file)
    return not isinstance(name, dict) or name.get("name") == sections.get(f"{part}.name")


def _read(file: Path) -> Any:
    return _parsed(file, file.stat().st_mtime_ns)


@lru_cache(maxsize=256)
def _parsed(file: Path, changed: int) -> Any:
    """A YAML file as it was when it was last changed; every name with differences asks for all models."""
    return OmegaConf.to_container(OmegaConf.load(file))


def variant_name(
    given: str, sections: Sections, models: Iterable[str], reference: Reference, parts: Callable[[], Sections | None]
) -> str:
    """The name of a composition.

    Args:
        given: what the chosen model's file calls it. sections: `decisive` of the composition.
        models: the files of the group `model`. reference: what each of them composes to; None also where it cannot be
            a composition of the same parts.
        parts: what the memory and the integration compose to with no value changed; None where that is not known.

    Returns:
        `given` if the user chose a name that is no model's, or if it is true; else the name of the model that equals
        the composition; else that of the nearest model with the same parts (or the parts' names) with the differences.
    """
    names = sorted(models)
    if given not in names:
        return given
    own = reference(given)
    if own is not None and own[1] == sections:
        return own[0]
    known = [found for found in map(reference, names) if found is not None]
    for name, theirs in known:
        if theirs == sections:
            return name
    alike = [found for found in known if _kind(found[1]) == _kind(sections)]
    if alike:
        name, base = min(alike, key=lambda found: (found[0] != given, len(_differences(found[1], sections))))
        return f"{name}-{_suffix(_differences(base, sections))}"
    name = "_".join(part for part in (sections.get(POLICY, ""), *_parts(sections)) if part) or "memoryless"
    plain = parts()
    if plain == sections:
        return name
    return f"{name}-{_suffix(_differences(plain or {}, sections), words=plain is not None)}"


def _parts(sections: Sections) -> tuple[str, str]:
    members = sections.get("memory.members")
    joined = [str(m.get("name") if isinstance(m, Mapping) else m) for m in members or ()]
    return "_".join(joined) or str(sections.get("memory.name", "")), str(sections.get("integration.name", ""))


def _kind(sections: Sections) -> tuple[str, ...]:
    return (str(sections.get(POLICY, "")), *_parts(sections))


def of_policy(section: Mapping[str, Any]) -> Sections:
    """The kind of policy, where it is not the usual one, which configurations did not use to name."""
    name = section.get("name", USUAL_POLICY)
    return {} if name == USUAL_POLICY else {POLICY: name}


def _differences(base: Sections, sections: Sections) -> Sections:
    keys = sorted(base.keys() | sections.keys())
    return {key: sections.get(key) for key in keys if base.get(key) != sections.get(key)}


def _suffix(differences: Sections, words: bool = True) -> str:
    """The differences in words where these are short, else a digest of them."""
    text = "-".join(f"{key.rpartition('.')[2]}_{_word(value)}" for key, value in differences.items())
    return text if words and len(text) <= LONGEST else digest(differences, 6)


def _word(value: Any) -> str:
    plain = "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)
    return re.sub(r"[^\w.]+", "_", plain).strip("_.")


def digest(values: Mapping[str, Any], letters: int) -> str:
    """So many letters that are equal for equal values, whatever their order."""
    text = json.dumps(values, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:letters]


def flat(values: Mapping[str, Any], prefix: str = "") -> Sections:
    """Nested sections as one, under dotted keys."""
    found: Sections = {}
    for key, value in values.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return found
