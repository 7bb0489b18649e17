"""Imports of the library point downward: the order of its packages, without exemption, and no cycle
at run time.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from helpers import REPOSITORY
from mme_vla.registry import extras

PACKAGE = REPOSITORY / "mme_vla"

# From the top: a package or top-level module imports only itself and what is below it.
EXTRAS = ["audit", "mikasa", "nano", "probing", "play", "trajectories", "methods"]
CORE = [
    "cli",
    "testing",
    "evaluation",
    "serving",
    "training",
    "subgoal",
    "envs",
    "data",
    "weights",
    "policy",
    "model",
    "processing",
    "integration",
    "memory",
    "backbone",
    "speed",
    "embodiment",
    "config",
    "types",
    "registry",
    "utils",
    "errors",
]
ORDER = ["entries", *(f"extras.{name}" for name in EXTRAS), *CORE]
ENTRIES = {
    "train", "evaluate", "results", "analyse", "probe", "inspect", "serve", "nano", "play",
    "__main__", "extras",
}  # fmt: skip
"""Top-level modules that only run a command; `mme_vla.extras` itself holds nothing but a text."""
APART = ("memory", "backbone")
"""Packages that do not import each other in either direction."""


@cache
def modules() -> dict[str, Path]:
    paths = {}
    for file in PACKAGE.rglob("*.py"):
        parts = ("mme_vla", *file.relative_to(PACKAGE).with_suffix("").parts)
        paths[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return paths


def level_of(module: str) -> str:
    """The entry of `ORDER` that a module belongs to; `mme_vla` itself, which loads lazily, is at
    the top.
    """
    parts = module.split(".")
    if parts[1:2] == ["extras"] and len(parts) > 2:
        return f"extras.{parts[2]}"
    if len(parts) == 1 or parts[1] in ENTRIES:
        return "entries"
    return parts[1]


@cache
def imports(module: str, for_types: bool = True) -> set[str]:
    """Modules of the library that a module imports anywhere: at run time, lazily, or for type
    checkers alone.
    """
    tree = ast.parse(modules()[module].read_text())
    if not for_types:
        tree.body = [
            node
            for node in tree.body
            if "TYPE_CHECKING" not in ast.unparse(getattr(node, "test", node))[:13]
        ]
    return set(_imports(tree)) - {module}


def _imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules())
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield from (
                    target
                    for target in (name, node.module)[name not in modules() :][:1]
                    if target in modules()
                )


def test_every_package_has_a_place_in_the_order() -> None:
    assert {level_of(module) for module in modules()} <= set(ORDER)


def test_imports_point_downward() -> None:
    upward = [
        f"{module} imports {target}"
        for module in modules()
        for target in imports(module)
        if ORDER.index(level_of(target)) < ORDER.index(level_of(module))
    ]
    assert upward == []


def test_the_core_names_no_extra() -> None:
    """Not in a string either: extras are found by listing `mme_vla.extras`."""
    for module, file in modules().items():
        if level_of(module) in CORE:
            assert "mme_vla.extras." not in file.read_text().replace("{name}", ""), file


NAMED_BY_EXTRAS = ("backbone", "policy", "processor", "prompt")
"""Kinds of parts whose names the core must not hold; names of others are words that it uses too."""
EVERYDAY = {"subtask"}


def test_the_core_holds_no_name_that_an_extra_registers() -> None:
    """No case for a method, its prompt or its checkpoint format stands in the core."""
    names: set[str] = set()
    for extension in extras():
        names |= set(extension.weight_formats) | set(extension.checkpoints)
        for kind in NAMED_BY_EXTRAS:
            names |= set(extension.parts.get(kind, {}))
    assert {"openvla", "simplememvla", "openvla_subgoal", "nano"} <= names
    for module, file in modules().items():
        if level_of(module) in CORE:
            constants = {
                node.value
                for node in ast.walk(ast.parse(file.read_text()))
                if isinstance(node, ast.Constant) and isinstance(node.value, str)
            }
            assert constants & names <= EVERYDAY, file


def test_an_extension_imports_nothing_but_the_registry() -> None:
    for name in EXTRAS:
        assert imports(f"mme_vla.extras.{name}.extension") == {"mme_vla.registry"}
        lines = modules()[f"mme_vla.extras.{name}"].read_text().splitlines()
        assert [line for line in lines if line.startswith("from mme_vla")] == []


def test_no_import_cycles() -> None:
    """Modules of one package may name each other's classes for type checkers."""
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, "cycle: " + " → ".join([*path[path.index(module) :], module])
        if module not in done:
            for target in sorted(imports(module, for_types=False)):
                visit(target, (*path, module))
            done.add(module)

    for module in modules():
        visit(module, ())


def test_memory_and_backbone_do_not_import_each_other() -> None:
    crossing = {f"{module} imports {target}" for module in modules() for target in imports(module)
                if {level_of(module), level_of(target)} == set(APART)}  # fmt: skip
    assert crossing == set()


def test_the_core_imports_without_transformers() -> None:
    """Language models that predict subgoals need it, and SAM2's encoder of one method."""
    for module, file in modules().items():
        if level_of(module) != "subgoal" and file.parent.name != "sam2act":
            lines = file.read_text().splitlines()  # methods import it where they build their towers
            assert not [
                line
                for line in lines
                if line.startswith(("import transformers", "from transformers"))
            ], file
