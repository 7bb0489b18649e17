"""The shell of the project: pins, the two commands, which room may import which, and what must not be in the files."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGE = REPOSITORY / "mme_vla"

# From the top: a room imports only from itself and from rooms further down.
ROOMS = [
    "play", "loading", "testing", "evaluation", "serving", "training", "data", "envs", "weights", "build", "policy",
    "saving", "episode", "subgoal", "finetune", "card", "processing", "integration", "memory", "backbone",
    "config", "config_errors", "hub", "pretrained", "naming", "embodiment", "types",
    "registry", "devices", "files", "errors",
]  # fmt: skip


def pyproject() -> dict:
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text())


def test_pins_for_pip_and_for_uv_are_the_same() -> None:
    lines = (REPOSITORY / "constraints.txt").read_text().splitlines()
    for_pip = {line.split("#")[0].strip() for line in lines} - {""}
    for_uv = pyproject()["tool"]["uv"]["constraint-dependencies"]
    assert for_pip == set(for_uv)
    assert len(for_uv) == len(for_pip), "a pin stands twice"
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in for_pip), "only name==version: no addresses, no ranges"


def test_every_direct_dependency_is_pinned() -> None:
    project = pyproject()["project"]
    wanted = project["dependencies"] + [r for rs in project["optional-dependencies"].values() for r in rs]
    pinned = {pin.split("==")[0] for pin in pyproject()["tool"]["uv"]["constraint-dependencies"]}
    assert {re.match(r"[\w-]+", requirement)[0] for requirement in wanted} <= pinned


def test_every_cap_gives_its_reason() -> None:
    capped = [line for line in (REPOSITORY / "pyproject.toml").read_text().splitlines() if re.search(r'"[^"]+,<', line)]
    assert capped
    assert [line for line in capped if "#" not in line] == []


def test_ci_runs_the_readmes_two_commands() -> None:
    commands = re.findall(r"^(pip install uv && .*uv run .*)$", (REPOSITORY / "README.md").read_text(), re.MULTILINE)
    run_by_ci = re.findall(r"^run '(.*)'$", (REPOSITORY / ".ci" / "run").read_text(), re.MULTILINE)
    assert commands == run_by_ci
    assert len(commands) == 2


def test_links_in_the_documentation_lead_to_files() -> None:
    broken = []
    for page in [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("**/*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text()):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page.relative_to(REPOSITORY)} → {target}")
    assert broken == []


def test_rooms_import_only_from_rooms_below_them() -> None:
    wrong = []
    for file in PACKAGE.rglob("*.py"):
        room = room_of(file.relative_to(PACKAGE).with_suffix("").as_posix())
        tree = ast.parse(file.read_text())
        if room == "__init__" or is_command(tree):
            continue
        assert room in ROOMS, f"{file} is in no known room: add it to ROOMS in this test, and to docs/architecture.md"
        for module in imports_at_run_time(tree):
            if module.startswith("mme_vla."):
                target = room_of(module.removeprefix("mme_vla.").replace(".", "/"))
                if target not in ROOMS or ROOMS.index(target) < ROOMS.index(room):
                    wrong.append(f"{file.relative_to(REPOSITORY)} imports {module}")
    assert wrong == []


def test_memory_and_backbone_do_not_know_each_other() -> None:
    for room, other in (("memory", "backbone"), ("backbone", "memory")):
        for file in (PACKAGE / room).rglob("*.py"):
            named = [m for m in imports_at_run_time(ast.parse(file.read_text())) if m.startswith(f"mme_vla.{other}")]
            assert named == [], file


def test_the_core_does_without_transformers() -> None:
    for file in PACKAGE.rglob("*.py"):
        if file.relative_to(PACKAGE).parts[0] == "subgoal":  # language models that predict subgoals
            continue
        roots = {module.split(".")[0] for module in imports_at_run_time(ast.parse(file.read_text()))}
        assert "transformers" not in roots, file


def test_no_file_names_a_place_on_somebodys_machine() -> None:
    # Bracketed so that the pattern does not find itself.
    places = re.compile(r"(?<![\w.~])/(?:wor[k]|roo[t]|hom[e]|User[s]|opt/\w+)/\w|index-ur[l]|find-link[s]|pypi\.or[g]")
    found = []
    for file in project_files():
        try:
            text = file.read_text()
        except UnicodeDecodeError:
            continue
        found += [f"{file.relative_to(REPOSITORY)}: {hit[0]}" for hit in places.finditer(text)]
    assert found == []


def test_importing_the_package_needs_torch_and_einops_only() -> None:
    heavy = ["lerobot", "hydra", "timm", "transformers", "h5py", "matplotlib", "accelerate", "tensorboard", "PIL"]
    run_python(f"""
        import sys
        for name in {heavy}: sys.modules[name] = None  # importing it raises ImportError
        import mme_vla
        from mme_vla import HistoryTokens, MemoryTokens, Batch, UserError, MEMORIES, INTEGRATIONS, BACKBONES
        from mme_vla import Memory, History, StorageSpec, OnlineHistory, CachedHistory
    """)


def test_the_policy_needs_nothing_of_data_training_or_simulation() -> None:
    heavy = ["lerobot", "hydra", "transformers", "h5py", "matplotlib", "accelerate", "tensorboard", "mani_skill"]
    run_python(f"""
        import sys
        for name in {heavy}: sys.modules[name] = None
        from mme_vla import MMEPolicy, Episode
    """)


def test_every_exported_name_can_be_reached() -> None:
    import mme_vla

    assert set(mme_vla.__all__) <= set(dir(mme_vla))
    assert all(getattr(mme_vla, name) is not None for name in mme_vla.__all__)
    assert mme_vla.__version__ == pyproject()["project"]["version"]
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = mme_vla.nothing


def run_python(code: str) -> None:
    lines = "\n".join(line.strip() for line in code.strip().splitlines())
    done = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr


def room_of(path: str) -> str:
    return path.split("/")[0]


def is_command(tree: ast.Module) -> bool:
    return any(isinstance(node, ast.If) and "__main__" in ast.unparse(node.test) for node in tree.body)


def imports_at_run_time(tree: ast.AST) -> Iterator[str]:
    """Every absolute module imported anywhere in the file, except for type checkers alone."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from (f"{node.module}.{a.name}" if node.module == "mme_vla" else node.module for a in node.names)
        yield from imports_at_run_time(node)


def project_files() -> Iterator[Path]:
    """What git tracks or would track; without git, the package and what stands beside it."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"], cwd=REPOSITORY, capture_output=True, text=True
    )
    if listed.returncode == 0:
        yield from (REPOSITORY / name for name in listed.stdout.split("\0") if name and (REPOSITORY / name).is_file())
    else:
        for pattern in ("*.*", "mme_vla/**/*.*", "configs/**/*.*", "tests/**/*.*", "docs/**/*.*"):
            yield from (file for file in REPOSITORY.glob(pattern) if file.is_file())
