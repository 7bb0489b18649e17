"""The rooms of the library: who may import whom, without exemption and without circles."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "mme_vla"

# From the top: a room imports only from itself and from rooms further down.
ROOMS = [
    "commands", "nano", "testing", "play", "evaluation", "serving", "training", "subgoal", "envs", "data", "weights",
    "policy", "processing", "integration", "memory", "backbone", "embodiment", "config", "types", "registry",
    "files",
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


@cache
def parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text())


@cache
def imports(file: Path) -> tuple[str, ...]:
    """Modules of this library that a file names, wherever in it: at run time, lazily, or for type checkers alone."""
    return tuple(_imports(file))


def _imports(file: Path) -> Iterator[str]:
    for node in ast.walk(parsed(file)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules())
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield from [name] if name in modules() else [node.module] if node.module in modules() else []


def is_entry(file: Path) -> bool:
    """A documented `python -m` name: it imports a command, runs it, and has nothing else in it."""
    return "from mme_vla.cli" in file.read_text() and len(parsed(file).body) == 3


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
    assert {"mme_vla.train", "mme_vla.evaluate", "mme_vla", "convert", "mme_vla.play.__main__"} <= entries
    for name, file in modules().items():
        assert not entries & set(imports(file)), f"{name} imports an entry; import the command's own module"
        if name.split(".")[-1] != "__main__" and name not in entries:
            plain = (node for node in parsed(file).body if not isinstance(node, ast.FunctionDef | ast.ClassDef))
            guarded = [node for node in plain if "__main__" in ast.unparse(node)[:40]]
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
        # Language models that predict subgoals; SAM2's encoder of a prior method.
        if file.relative_to(PACKAGE).parts[0] == "subgoal" or file.parent.name == "sam2act":
            continue
        lines = file.read_text().splitlines()  # prior methods import it where they build or read their towers
        assert not [line for line in lines if line.startswith(("import transformers", "from transformers"))], file


def test_the_top_level_is_a_dozen_files() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= TOP_LEVEL


# Names that several modules have because they are the same thing in each room.
ALIKE = {
    "base": "the contract of a room",
    "settings": "what a command may be told",
    "progress": "the bar a person sees",
    "pictures": "images on their way to the network: how they are made ready, which are asked for",
    "episodes": "the episodes there are: of the benchmark, of a dataset",
    "sizes": "what a network is built to",
    "backbone": "the network of its folder",
    "policy": "the policy of its folder",
    "processing": "what stands between raw data and the policy of its folder",
    "episode": "an episode as its policy knows it",
    "openvla": "OpenVLA in this room: policy, processor, checkpoints, names",
    "memoryvla": "MemoryVLA in this room: checkpoints, names",
}
WRITING, READING = {"remember", "look", "observe"}, {"select", "gather_selection", "encode", "gather"}


def test_no_two_modules_of_one_name_mean_different_things() -> None:
    named: dict[str, list[str]] = {}
    for name, file in modules().items():
        # A command is called as what it runs, and its entry as the command.
        if file.stem != "__init__" and not is_entry(file) and name.split(".")[1:2] != ["commands"]:
            named.setdefault(file.stem, []).append(name)
    twice = {stem: found for stem, found in named.items() if len(found) > 1}
    assert set(twice) == set(ALIKE), f"one name for two things: {twice}"


def test_episodes_write_and_memories_read_under_names_of_their_own() -> None:
    methods: dict[str, set[str]] = {}
    for room in ("memory", "policy", "subgoal"):
        for file in (PACKAGE / room).rglob("*.py"):
            for node in ast.walk(parsed(file)):
                if isinstance(node, ast.ClassDef):
                    defined = {f.name for f in node.body if isinstance(f, ast.FunctionDef)}
                    methods.setdefault(room if room == "memory" else node.name, set()).update(defined)
    assert not methods["memory"] & WRITING, "a memory selects and encodes; Episode is what is written to"
    assert methods["memory"] >= READING and methods["Episode"] >= WRITING
    assert not methods["Episode"] & (READING - {"gather_selection"})
