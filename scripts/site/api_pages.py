"""The page of what `from mme_vla import …` offers, from signatures and docstrings."""

import inspect
import re
from typing import Any

import mme_vla

INTRODUCTION = """# API

Everything below is imported from `mme_vla` itself, and loaded when it is first used. [From Python](../start/python.md)
shows it at work.
"""  # noqa: E501
GROUPS = {
    "A policy": ["build_policy", "MMEPolicy", "Policy", "Episode", "load_weights"],
    "Evaluation": ["evaluate", "probe", "make_env", "make_vec_env"],
    "Parts to subclass": [
        "Memory",
        "PerceptualMemory",
        "RecurrentMemory",
        "Perturbation",
        "Integration",
        "Backbone",
        "Task",
        "Environment",
        "SubgoalPredictor",
        "register",
    ],
    "What parts are given": [
        "Batch",
        "HistoryTokens",
        "MemoryTokens",
        "History",
        "OnlineHistory",
        "CachedHistory",
        "StorageSpec",
        "Embodiment",
    ],
    "Mistakes": ["UserError"],
}


def signature(thing: Any) -> str:
    """The arguments as written, without the modules of the types' names."""
    try:
        text = str(inspect.signature(thing))
    except (TypeError, ValueError):
        return ""
    text = re.sub(r"<function (\w+) at \w+>", r"\1", text)
    text = re.sub(r"(: |-> )'([^']+)'", r"\1\2", text)  # types that are named before they exist
    return re.sub(r"\b(?:[a-z_]\w*\.)+(?=[A-Za-z_])", "", text)


def wrapped(call: str, width: int = 76) -> str:
    """A call with each argument on a line of its own where it is wider than the page's
    code blocks.
    """
    if len(call) <= width:
        return call
    lines, depth = [""], 0
    for character in call:
        depth -= character in ")]}"
        if depth == 0 and character == ")" and len(lines) > 1:
            lines.append("")
        lines[-1] += character
        if depth == 0 and character == "(" and len(lines) == 1:
            lines.append("    ")
        depth += character in "([{"
        if depth == 1 and character == "," and len(lines) > 1:
            lines.append("   ")
    return "\n".join(line.rstrip() for line in lines)


def text_of(thing: Any) -> str:
    """The docstring: prose as it is; sections and examples, whose layout carries
    meaning, as code.
    """
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
    """The public methods and properties that a class of this library defines itself, in the order
    of the file.
    """
    found = []
    for name, member in vars(kind).items():
        shown = inspect.isfunction(member) or isinstance(
            member, property | classmethod | staticmethod
        )
        if shown and not name.startswith("_") and inspect.getdoc(getattr(kind, name)):
            found.append((name, member))
    return found


def section(name: str) -> str:
    """A name with its signature, its docstring and, for a class, its methods."""
    try:
        thing = getattr(mme_vla, name)
    except ImportError as error:
        return (
            f"### `{name}`\n\nNot described here, since the site was built without `{error.name}`."
        )
    called = wrapped(f"{name}{signature(thing)}") if signature(thing) else ""
    head = f"from mme_vla import {name}  # {thing.__module__}\n{called}".rstrip()
    parts = [f"### `{name}`", f"```python\n{head}\n```", text_of(thing)]
    if inspect.isclass(thing) and not issubclass(thing, Exception):
        for method, member in members(thing):
            call = "" if isinstance(member, property) else signature(getattr(thing, method))
            parts.append(f"#### `.{method}`")
            if call:
                parts.append(f"```python\n{wrapped(f'{method}{call}')}\n```")
            parts.append(text_of(getattr(thing, method)))
    return "\n\n".join(parts)


def page() -> str:
    """The whole page.

    Raises:
        ValueError: a public name is in no group.
    """
    named = {name for names in GROUPS.values() for name in names}
    # registries aside
    public = {name for name in mme_vla.__all__ if name != "__version__" and not name.isupper()}
    if public != named:
        raise ValueError(
            "scripts/site/api_pages.py: GROUPS names other things than mme_vla:"
            f" {sorted(public ^ named)}"
        )
    parts = [INTRODUCTION.strip()]
    for title, names in GROUPS.items():
        parts += [f"## {title}", *map(section, names)]
    return "\n\n".join(parts) + "\n"
