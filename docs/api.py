"""Writes docs/api.md, what `from mme_vla import …` offers, from signatures and docstrings: `python docs/api.py`."""

import inspect
import re
from pathlib import Path
from typing import Any

import mme_vla
from mme_vla.registry import Registry

PAGE = Path(__file__).resolve().parent / "api.md"
INTRODUCTION = """# What `mme_vla` offers

Written by `python docs/api.py` from the docstrings; a test keeps the two equal. Everything below is imported from
`mme_vla` itself, and loaded when it is first used. [From Python](python.md) shows it at work.
"""
GROUPS = {
    "A policy": ["build_policy", "MMEPolicy", "Policy", "Episode", "load_weights"],
    "Evaluation": ["evaluate", "probe", "make_env", "make_vec_env"],
    "Parts to subclass": [
        "Memory", "PerceptualMemory", "RecurrentMemory", "Integration", "Backbone", "Task", "Environment",
        "SubgoalPredictor", "register",
    ],
    "What parts are given": [
        "Batch", "HistoryTokens", "MemoryTokens", "History", "OnlineHistory", "CachedHistory", "StorageSpec",
        "Embodiment",
    ],
    "Mistakes": ["UserError"],
}  # fmt: skip


def signature(thing: Any) -> str:
    """The arguments as written, without the homes of the types' names."""
    try:
        text = str(inspect.signature(thing))
    except (TypeError, ValueError):
        return ""
    text = re.sub(r"<function (\w+) at \w+>", r"\1", text)
    text = re.sub(r"(: |-> )'([^']+)'", r"\1\2", text)  # types that are named before they exist
    return re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Za-z_])", "", text)


def text_of(thing: Any) -> str:
    """The docstring: prose as it is; sections and examples, whose layout carries meaning, as code."""
    blocks = (inspect.getdoc(thing) or "").split("\n\n")
    parts: list[str] = []
    kept: list[str] = []
    for block in blocks:
        if re.match(r"(Args|Returns|Raises|Yields|Attributes):|>>> |\s", block):
            kept.append(block)
            continue
        parts += [*_fenced(kept), block]
        kept = []
    return "\n\n".join([*parts, *_fenced(kept)])


def _fenced(blocks: list[str]) -> list[str]:
    return ["```text\n" + "\n\n".join(blocks) + "\n```"] if blocks else []


def members(kind: type) -> list[tuple[str, Any]]:
    """The public methods and properties that a class of this library defines itself, in the order of the file."""
    found = []
    for name, member in vars(kind).items():
        shown = inspect.isfunction(member) or isinstance(member, property | classmethod | staticmethod)
        if shown and not name.startswith("_") and inspect.getdoc(getattr(kind, name)):
            found.append((name, member))
    return found


def section(name: str) -> str:
    """A name with its signature, its words and, for a class, its methods."""
    thing = getattr(mme_vla, name)
    called = signature(thing)
    head = f"from mme_vla import {name}  # {thing.__module__}" + (f"\n{name}{called}" if called else "")
    parts = [f"### `{name}`", f"```python\n{head}\n```", text_of(thing)]
    if inspect.isclass(thing) and not issubclass(thing, Exception):
        for method, member in members(thing):
            bare = getattr(thing, method)
            head = f"`.{method}`" if isinstance(member, property) else f"`.{method}{signature(bare)}`"
            parts.append(f"**{head}**\n\n{text_of(bare)}")
    return "\n\n".join(parts)


def page() -> str:
    """The whole page.

    Raises:
        ValueError: a public name is in no group.
    """
    named = {name for names in GROUPS.values() for name in names}
    known = {name for name in mme_vla.__all__ if name != "__version__"}
    rest = {name for name in known if not isinstance(getattr(mme_vla, name), Registry)}
    if rest != named:
        raise ValueError(f"docs/api.py: these names stand in no group, or in one too many: {sorted(rest ^ named)}")
    parts = [INTRODUCTION.strip()]
    for title, names in GROUPS.items():
        parts += [f"## {title}", *map(section, names)]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
