"""A griffe extension: docstrings of this library as griffe's Google parser and Markdown read them.

In the sources an entry may describe several arguments, fields stand in a paragraph without a title,
and an example has no heading. Here each gets the form that becomes a table, a list or a block
of code, and names in backticks become links.
"""

import re
from pathlib import Path
from typing import Any

import griffe

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = re.compile(r"docs/([\w/-]+)\.md")
SECTIONS = ("Args:", "Attributes:")
OTHER_SECTIONS = ("Returns:", "Raises:", "Yields:", "Examples:", "Example:")
ENTRY = re.compile(r"(\w+(?:, \w+)*): (?=\S)")


class Docstrings(griffe.Extension):
    """Rewrites the docstrings of a package that was loaded."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Rewrite every docstring below the package."""
        targets = _documented(pkg)
        for item in _walk(pkg):
            if item.docstring:
                item.docstring.value = rewritten(item.docstring.value, names_of(item))
                item.docstring.value = linked(item.docstring.value, item, targets)


def _walk(item: griffe.Object) -> list[griffe.Object]:
    below = [item]
    for member in item.members.values():
        if not member.is_alias:
            below += _walk(member)  # type: ignore[arg-type]
    return below


def _documented(pkg: griffe.Module) -> dict[str, str]:
    """Name of a public class or function → its path, where only one has the name."""
    found: dict[str, set[str]] = {}
    for item in _walk(pkg):
        is_part = item.is_class or (item.is_function and item.parent and item.parent.is_module)
        if is_part and not item.name.startswith("_"):
            found.setdefault(item.name, set()).add(item.path)
    return {name: paths.pop() for name, paths in found.items() if len(paths) == 1}


def names_of(item: griffe.Object) -> set[str]:
    """The arguments of a function, or the attributes and arguments of a class."""
    if item.is_class:
        names = set(item.members) | set(item.inherited_members)
        init = item.members.get("__init__")
        if init is not None and not init.is_alias:
            names |= {parameter.name for parameter in init.parameters}  # type: ignore[union-attr]
        return names
    if item.is_function:
        return {parameter.name.lstrip("*") for parameter in item.parameters}  # type: ignore[attr-defined]
    return set()


def rewritten(text: str, names: set[str]) -> str:
    """A docstring in the form that the parser reads.

    Args:
        text: the docstring.
        names: what its entries may describe.
    """
    blocks = []
    for block in re.split(r"\n\s*\n", text):
        blocks.append(_block(block, names))
    return "\n\n".join(blocks)


def _block(block: str, names: set[str]) -> str:
    head, _, below = block.partition("\n")
    if head.startswith(">>> "):
        code = re.sub(r" *# doctest: \+\w+", "", block)
        return f"```python\n{code}\n```"
    if head in SECTIONS:
        return f"{head}\n{_entries(below)}"
    if head in OTHER_SECTIONS:
        return block
    match = ENTRY.match(head)
    if match and set(match[1].split(", ")) <= names:
        return f"Attributes:\n{_entries(_indented(block))}"
    if head.endswith(":") and below and all(line.startswith("    ") for line in below.split("\n")):
        return f"{head}\n\n{_list(below)}"
    # A heading may follow sentences.
    lines = block.split("\n")
    for i, line in enumerate(lines[:-1]):
        rest = lines[i + 1 :]
        if line.endswith(":") and all(other.startswith("    ") for other in rest):
            entries = "\n".join(rest)
            if re.match(r"    \w+(, \w+)*: ", entries):
                return "\n".join(lines[: i + 1]) + f"\n\n{_list(entries)}"
    return block


def _indented(block: str) -> str:
    """A paragraph whose entries begin at the margin, one step deeper."""
    return "\n".join(f"    {line}" for line in block.split("\n"))


def _split(below: str) -> list[tuple[str, str]]:
    """Pairs of name and text; each entry begins on a line of its own."""
    joined: list[str] = []
    for line in below.split("\n"):
        starts = re.match(r" {4}(\*{0,2}\w+(?:, \w+)*): ", line)
        if starts or not joined:
            joined.append(line.strip())
        else:
            joined[-1] += " " + line.strip()
    pairs = []
    for entry in joined:
        name, _, text = entry.partition(": ")
        pairs.append((name, text.strip()))
    return pairs


def _entries(below: str) -> str:
    """Entries of a section, each name on a line of its own."""
    lines = []
    for names_together, text in _split(below):
        for name in names_together.split(", "):
            lines.append(f"    {name}: {text}")
    return "\n".join(lines)


def _list(below: str) -> str:
    """Entries below a heading of their own as a Markdown list."""
    return "\n".join(f"- `{name}`: {text}" for name, text in _split(below))


def linked(text: str, item: griffe.Object, targets: dict[str, str]) -> str:
    """A docstring in which names of public things in backticks are links."""

    def link(match: re.Match[str]) -> str:
        first, _, rest = match[1].partition(".")
        path = targets.get(first)
        if path is None or path == item.path:
            return match[0]
        identifier = f"{path}.{rest}" if rest else path
        return f'<autoref optional identifier="{identifier}"><code>{match[1]}</code></autoref>'

    parts = re.split(r"(^```.*?^```)", text, flags=re.DOTALL | re.MULTILINE)
    for i, part in enumerate(parts):
        if not part.startswith("```"):
            parts[i] = PAGE.sub(page_link, re.sub(r"`([A-Za-z_][\w.]*)`", link, part))
    return "".join(parts)


def page_link(match: re.Match[str]) -> str:
    """A link to a page of the documentation from a page of the API; the path where it is none."""
    file = REPOSITORY / "docs" / f"{match[1]}.md"
    if not file.is_file():
        return match[0]
    title = file.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ").replace("`", "")
    return f'<a href="../../{match[1]}.html">{title}</a>'
