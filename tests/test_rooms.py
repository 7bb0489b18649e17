"""The rooms of the library: who may import whom, without exemption and without circles."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "mme_vla"

# From the top: a room imports only from itself and from rooms further down.
ROOMS = [
    "commands", "nano", "testing", "play", "evaluation", "serving", "training", "subgoal", "envs", "data", "weights", "policy",
    "processing", "integration", "memory", "backbone", "config", "media", "embodiment", "types", "registry", "files",
    "errors",
]  # fmt: skip
TOP_LEVEL = 12  # files


@cache
def modules() -> dict[str, Path]:
    found = {}
    for file in PACKAGE.rglob("*.py"):
        parts = ("mme_vla", *file.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports(file: Path) -> Iterator[str]:
    """Modules of this library that a file names, wherever in it: at run time, lazily, or for type checkers alone."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules())
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield from [name] if name in modules() else [node.module] if node.module in modules() else []


def is_entry(file: Path) -> bool:
    """A documented `python -m` name: it imports a command, runs it, and has nothing else in it."""
    return "from mme_vla.commands" in file.read_text() and len(ast.parse(file.read_text()).body) == 3


def test_rooms_import_only_from_rooms_below_them() -> None:
    wrong = []
    for name, file in modules().items():
        room = name.split(".")[1] if "." in name else ""
        if name in ("mme_vla", "mme_vla.__main__") or is_entry(file):
            continue
        assert room in ROOMS, f"{file} is in no known room: add it to ROOMS in this test, and to docs/architecture.md"
        for target in imports(file):
            other = target.split(".")[1] if "." in target else ""
            if other not in ROOMS or ROOMS.index(other) < ROOMS.index(room):
                wrong.append(f"{name} imports {target}")
    assert wrong == []


def test_entries_hold_a_command_and_nothing_else_and_nobody_imports_them() -> None:
    entries = {name for name, file in modules().items() if is_entry(file)}
    assert {"mme_vla.train", "mme_vla.evaluate", "mme_vla.data.convert", "mme_vla.play.__main__"} <= entries
    for name, file in modules().items():
        assert not entries & set(imports(file)), f"{name} imports an entry; import the command's own module"
        if name.split(".")[-1] != "__main__" and name not in entries:
            guarded = [node for node in ast.parse(file.read_text()).body if "__main__" in ast.unparse(node)[:40]]
            assert not guarded, f"{name} runs as a script: commands are in mme_vla/commands, entries only call them"


def test_no_import_goes_in_a_circle() -> None:
    graph = {name: sorted(set(imports(file)) - {name}) for name, file in modules().items()}
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, "a circle: " + " → ".join([*path[path.index(name) :], name])
        if name not in done:
            for target in graph[name]:
                visit(target, (*path, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_memory_and_backbone_do_not_know_each_other() -> None:
    for room, other in (("memory", "backbone"), ("backbone", "memory")):
        for file in (PACKAGE / room).rglob("*.py"):
            assert [m for m in imports(file) if m.startswith(f"mme_vla.{other}")] == [], file


def test_the_core_does_without_transformers() -> None:
    for file in PACKAGE.rglob("*.py"):
        if file.relative_to(PACKAGE).parts[0] == "subgoal":  # language models that predict subgoals
            continue
        assert "import transformers" not in file.read_text() and "from transformers" not in file.read_text(), file


def test_the_top_level_is_a_dozen_files() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= TOP_LEVEL
