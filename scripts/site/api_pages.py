"""The pages of what `from mme_vla import …` offers.

The navigation of `mkdocs.yml` says which names there are, in which groups. `mkdocstrings` reads
signatures and docstrings from the sources, so that no module is imported.
"""

import ast
from functools import cache
from typing import Any

from config_pages import REPOSITORY

import mme_vla

FOLDER = "reference/api/"
MODULES = f"{FOLDER}mme_vla."
"""Pages of modules begin so, with the types beside the public names."""
REGISTRIES = "registries"
"""The page of the constants."""
INTRODUCTION = """# API

Names are imported from `mme_vla`, and loaded when they are first used. Types under *Modules*
are imported from their module. [From Python](../start/python.md) shows it at work.
"""
FORMER_NAMES = {"Memory": "MemoryModule"}
"""Public name → the class that it is another name of."""


def public_names() -> set[str]:
    """The names that have a page of their own."""
    return {name for name in mme_vla.__all__ if not name.startswith("_") and not name.isupper()}


def target_of(name: str) -> str:
    """The dotted path of a public name."""
    module, real = mme_vla._HOME[name], FORMER_NAMES.get(name, name)
    for node in _tree(module).body:  # a package imports it from the module that has it
        if isinstance(node, ast.ImportFrom) and real in [alias.name for alias in node.names]:
            return f"{node.module}.{real}"
    return f"{module}.{real}"


def groups(nav: list[Any]) -> dict[str, list[str]]:
    """Title → pages, of the groups below *API* in the navigation."""
    for entry in nav:
        if not isinstance(entry, dict):
            continue
        for title, below in entry.items():
            if title == "API":
                return {name: pages for group in below[1:] for name, pages in group.items()}
            if isinstance(below, list) and (match := groups(below)):
                return match
    return {}


def check(nav: list[Any]) -> None:
    """Make sure that the navigation has every public name.

    Raises:
        ValueError: it has other names than `mme_vla` exports.
    """
    stems = {page.removeprefix(FOLDER)[:-3] for pages in groups(nav).values() for page in pages}
    named = {stem for stem in stems if not stem.startswith("mme_vla.")} - {REGISTRIES}
    if named != public_names():
        raise ValueError(
            "mkdocs.yml: the navigation of the API names other things than mme_vla:"
            f" {sorted(named ^ public_names())}"
        )


def pages(nav: list[Any]) -> dict[str, str]:
    """Path under `docs/` → Markdown: the overview, and a page a name or module."""
    check(nav)
    result = {"reference/api.md": overview(nav)}
    for group in groups(nav).values():
        for path in group:
            stem = path.removeprefix(FOLDER).removesuffix(".md")
            if path.startswith(MODULES):
                result[path] = module_page(stem)
            elif stem == REGISTRIES:
                result[path] = registries_page()
            else:
                result[path] = page(stem)
    return result


def page(name: str) -> str:
    """The page of one name."""
    target = target_of(name)
    options = f"    options:\n      heading_level: 1\n      heading: {name}\n"
    text = f"---\ntitle: {name}\n---\n\n::: {target}\n{options}\n"
    if name in FORMER_NAMES:
        text += f"`{name}` is another name of `{target}`.\n\n"
    return f"{text}```python\nfrom mme_vla import {name}  # {target}\n```\n"


def module_page(module: str) -> str:
    """The page of a module: its types that are no public name of the package."""
    own_pages = {target_of(name) for name in public_names()}
    members = [name for name in classes(module) if f"{module}.{name}" not in own_pages]
    listed = "".join(f"        - {member}\n" for member in members)
    options = (
        "    options:\n      heading_level: 1\n      show_root_heading: true\n"
        f"      show_root_full_path: true\n      members:\n{listed}"
    )
    return f"---\ntitle: {module.removeprefix('mme_vla.')}\n---\n\n::: {module}\n{options}"


def registries_page() -> str:
    """The constants: tables of parts by name."""
    rows = []
    for name in sorted(name for name in mme_vla.__all__ if name.isupper()):
        rows.append(f"| `{name}` | `{mme_vla._HOME[name]}` |")
    table = "\n".join(["| name | module |", "|---|---|", *rows])
    return (
        "# Registries\n\nA registry maps names of configurations to classes."
        f" [`register`](register.md) adds to it.\n\n{table}\n\n::: mme_vla.registry.Registry\n"
        "    options:\n      heading_level: 2\n      show_root_heading: true\n"
    )


def overview(nav: list[Any]) -> str:
    """Every page with the first sentence of its docstring."""
    parts = [INTRODUCTION.strip()]
    for title, paths in groups(nav).items():
        rows = []
        for path in paths:
            stem = path.removeprefix(FOLDER).removesuffix(".md")
            rows.append(f"| [`{stem}`](api/{stem}.md) | {first_sentence(stem)} |")
        parts += [f"## {title}", "\n".join(["| name | |", "|---|---|", *rows])]
    return "\n\n".join(parts) + "\n"


def first_sentence(stem: str) -> str:
    """What a docstring begins with."""
    if stem == REGISTRIES:
        return "Names of configurations, and the classes that they select."
    if stem.startswith("mme_vla."):
        text = ast.get_docstring(_tree(stem)) or ""
    else:
        module, _, name = target_of(stem).rpartition(".")
        text = next(
            ast.get_docstring(node) or ""
            for node in _tree(module).body
            if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name
        )
    return " ".join(text.partition("\n\n")[0].split()).replace("|", "\\|")


def classes(module: str) -> list[str]:
    """Public classes of a module in the order of the file."""
    return [
        node.name
        for node in _tree(module).body
        if isinstance(node, ast.ClassDef)
        and not node.name.startswith("_")
        and ast.get_docstring(node)
    ]


@cache
def _tree(module: str) -> ast.Module:
    path = REPOSITORY / module.replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(file.read_text(encoding="utf-8"))
