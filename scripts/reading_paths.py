"""Files, functions and lines that a reader needs for eight questions about the library
(docs/extend/layout.md).

(a), (d) and (g) read the tables of docs/extend/architecture.md, whose functions are counted; the
others list the files on the way. Every file is checked to exist, and every function of (a), (d),
(f), (g) and (h) to be defined where it is listed.

    uv run python scripts/reading_paths.py
"""

import ast
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "mme_vla"

TABLES = "docs/extend/architecture.md"
LOSS = "### One loss, step by step"
CHUNK = "### One chunk, step by step"
EPISODE = "### One episode, step by step"
"""The functions of (a), (d) and (g), in the order of reading. Beside those of (g): what is loaded
(`policy/saving.py`), what a terminal shows (`evaluation/rollout/progress.py`), the run's folder
(`evaluation/store.py`, and `claims.py` where processes share it), its receipt (`receipts.py`), and,
where they are asked for, events, subgoals and videos (`evaluation/rollout/`).
"""
SELECTION = ["memory/tokendrop.py", "memory/history.py", "memory/base.py"]
HEAD = ["backbone/flow.py"]
TRAINING = [
    ("cli/train.py", "main"), ("training/settings.py", "from_config"),
    ("training/runs.py", "claim_run"), ("training/data.py", "prepare_data"),
    ("training/loop.py", "update"), ("training/order.py", "batch"),
    ("training/optim.py", "make_optimizer"), ("training/checkpoint.py", "save_checkpoint"),
]  # fmt: skip
"""From the command line to the last checkpoint of one process; `training/parallel.py` and
`training/shards.py` are for several.
"""
EPISODE_BESIDE = [
    ("cli/evaluate.py", "evaluate_one"), ("policy/scheduler.py", "Scheduler.next_steps"),
    ("policy/base.py", "Policy.act"), ("envs/interface.py", "RoboMMEEnv.step"),
]  # fmt: skip
"""Functions that the rows of (g) name and do not list."""
EXTENSIONS = [
    ("registry.py", "installed_extensions"), ("config/trees.py", "library_trees"),
    ("config/composition.py", "manipulate_search_path"), ("policy/saving.py", "policy_class"),
    ("cli/table.py", "commands"), ("cli/__init__.py", "run"),
]  # fmt: skip
ALONE = "README.md"
QUESTIONS = (
    "How does FrameSamp + Modulator work, from images and stored tokens to the loss?",
    "Change the selection rule of TokenDrop",
    "Another flow head (noise schedule, time distribution, sampler)",
    "Where is an action chunk sampled?",
    "Backbone, memory and integration alone in your own training loop",
    "What does `mme_vla.train` do, from the command line to a checkpoint?",
    "What happens to an episode, from `mme-vla evaluate` to its record?",
    "How is a method or a command of an extra or a package found?",
)
"""(a) to (h), as docs/extend/layout.md has them."""


def check(files: list[Path]) -> list[Path]:
    """The files, each of which must exist."""
    if missing := [str(file) for file in files if not file.is_file()]:
        sys.exit(f"no such file: {', '.join(missing)}; update the lists in {Path(__file__).name}")
    return files


def named(file: Path, name: str) -> list[ast.FunctionDef]:
    """The functions of a file with this name; of `Class.name`, those of that class."""
    owner, _, function = name.rpartition(".")
    found = []
    for scope in ast.walk(ast.parse(file.read_text())):
        if not isinstance(scope, ast.Module | ast.ClassDef):
            continue
        if owner and getattr(scope, "name", "") != owner:
            continue
        for node in scope.body:
            if isinstance(node, ast.FunctionDef) and node.name == function:
                found.append(node)
    if not found:
        sys.exit(f"{file} defines no {name}(); update the list that names it")
    return found


def defining(calls: list[tuple[str, str]]) -> list[Path]:
    """The files of some functions, each of which must define its own."""
    files = check([PACKAGE / name for name, _ in calls])
    for file, (_, call) in zip(files, calls, strict=True):
        named(file, call)
    return list(dict.fromkeys(files))


def chain(heading: str) -> list[tuple[str, str]]:
    """The file and the name of each function in the table below a heading of `TABLES`."""
    _, _, below = (ROOT / TABLES).read_text().partition(f"{heading}\n")
    section, _, _ = below.partition("\n#")
    calls = []
    for row in section.splitlines():
        if row.startswith("| `"):
            _, file, functions, _ = row.split("|", 3)
            calls += [(file.strip(" `"), name) for name in re.findall(r"`([\w.]+)`", functions)]
    return calls


def lines_of(calls: list[tuple[str, str]]) -> int:
    """Lines of some functions."""
    lines = 0
    for file, name in calls:
        (node,) = named(PACKAGE / file, name)
        assert node.end_lineno is not None
        lines += node.end_lineno - node.lineno + 1
    return lines


def chained(heading: str) -> tuple[str, list[Path]]:
    """What the table below a heading takes to read, its lines rounded up to fifties, and its
    files.
    """
    calls = chain(heading)
    files = defining(calls)
    at_most = -(-lines_of(calls) // 50) * 50
    return f"{len(calls)} functions, at most {at_most} lines in {count(files)}", files


def block(page: str) -> str:
    """The example of the model alone on a page."""
    blocks = (part.split("```")[0] for part in (ROOT / page).read_text().split("```python\n")[1:])
    (code,) = (code for code in blocks if "MMEModel(" in code)
    return code


def example() -> tuple[int, int]:
    """Lines of the README's example of the model alone, and the modules of the library that the
    full one imports.
    """
    count = (
        "\nimport sys\nprint(len([name for name in sys.modules if name.split('.')[0] =="
        " 'mme_vla']))"
    )
    command = [sys.executable, "-c", block("docs/start/python.md") + count]
    result = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    return len([line for line in block(ALONE).splitlines() if line.strip()]), int(
        result.stdout.split()[-1]
    )


def count(files: list[Path]) -> str:
    """How many files."""
    return "1 file" if len(files) == 1 else f"{len(files)} files"


def answers() -> list[tuple[str, list[Path]]]:
    """What (a) to (h) take, and the files."""
    lines, modules = example()
    trained, extensions = defining(TRAINING), defining(EXTENSIONS)
    selection, head = (check([PACKAGE / n for n in names]) for names in (SELECTION, HEAD))
    return [
        chained(LOSS),
        (count(selection), selection),
        (count(head), head),
        chained(CHUNK),
        (f"{lines} lines, {modules} modules imported", [ROOT / ALONE]),
        (count(trained), trained),
        chained(EPISODE),
        (count(extensions), extensions),
    ]


def main() -> None:
    """Print the table."""
    print("| question | to read | files |\n|---|---|---|")
    for question, (take, files) in zip(QUESTIONS, answers(), strict=True):
        names = ", ".join(f"`{file.relative_to(ROOT)}`" for file in files)
        print(f"| {question} | {take} | {names} |")


if __name__ == "__main__":
    main()
