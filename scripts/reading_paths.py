"""Files and lines that a reader needs for seven questions about the library
(docs/extend/layout.md).

(a) and (e) follow imports from a starting point; the others list the files on the way. Every file
is checked to exist, and every call of (d), (f) and (g) to be defined where it is listed.

    python scripts/reading_paths.py
"""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "mme_vla"

MODEL = [
    "mme_vla.model",
    "mme_vla.backbone.pi05",
    "mme_vla.memory.framesamp",
    "mme_vla.integration.modulator",
]
"""FrameSamp + Modulator, from image to loss."""
NOT_READ = {
    "mme_vla",
    "mme_vla.errors",
    "mme_vla.memory.sizes",
    "mme_vla.registry",
    "mme_vla.speed",
}
"""Of no concern to the mathematics: messages, checks of settings, tables of names, and marks of
what can be made faster.
"""
SELECTION = ["memory/tokendrop.py", "memory/history.py", "memory/base.py"]
HEAD = ["backbone/flow.py"]
SAMPLING = [
    ("policy/base.py", "act"), ("policy/base.py", "choose_actions"),
    ("policy/mme.py", "predict_chunk"), ("policy/mme.py", "sample_actions"),
    ("model.py", "sample"), ("backbone/pi05.py", "sample"),
]  # fmt: skip
TRAINING = [
    ("cli/train.py", "main"), ("training/settings.py", "from_config"),
    ("training/runs.py", "claim_run"), ("training/data.py", "prepare_data"),
    ("training/loop.py", "update"), ("training/order.py", "batch"),
    ("training/optim.py", "make_optimizer"), ("training/checkpoint.py", "save_checkpoint"),
]  # fmt: skip
"""From the command line to the last checkpoint of one process; `training/parallel.py` and
`training/shards.py` are for several.
"""
EVALUATION = [
    ("cli/evaluate.py", "evaluate_one"), ("evaluation/rollout/settings.py", "from_config"),
    ("evaluation/rollout/evaluation.py", "run"), ("evaluation/rollout/runner.py", "rounds"),
    ("envs/vector/pool.py", "recv"), ("envs/vector/pool.py", "serve"),
    ("evaluation/rollout/environment.py", "step"), ("envs/interface.py", "step"),
    ("evaluation/rollout/running.py", "read"), ("policy/episode.py", "observe"),
    ("policy/scheduler.py", "next_steps"), ("policy/base.py", "act"),
    ("evaluation/records.py", "to_json"), ("evaluation/records.py", "append"),
]  # fmt: skip
"""From the command line to the line of an episode's record; (d) continues from `act`. Before it,
what is loaded and built: the policy (`policy/saving.py`), and the task in its scene
(`envs/make.py`, where `make_env` returns the `RoboMMEEnv` of `envs/interface.py`). Beside it: what
a terminal shows (`rollout/progress.py`), the run's folder (`store.py`: `claim_run`, and `Claims`
where several processes share a run), its receipt (`receipts.py`), and, where they are asked for,
events (`rollout/events.py`), subgoals (`rollout/subgoals.py`) and videos (`rollout/video.py`).
"""
ALONE = "README.md"
QUESTIONS = (
    "How does FrameSamp + Modulator work, from images and stored tokens to the loss?",
    "Change the selection rule of TokenDrop",
    "Another flow head (noise schedule, time distribution, sampler)",
    "Where is an action chunk sampled?",
    "Backbone, memory and integration alone in your own training loop",
    "What does `mme_vla.train` do, from the command line to a checkpoint?",
    "What happens to an episode, from `mme_vla.evaluate` to its record?",
)
"""(a) to (g), as docs/extend/layout.md has them."""


def path_of(module: str) -> Path | None:
    """The file of a module of the library."""
    base = ROOT.joinpath(*module.split("."))
    return next((p for p in (base.with_suffix(".py"), base / "__init__.py") if p.is_file()), None)


def imports(file: Path) -> set[str]:
    """Modules of the library that a file imports when it is imported itself."""
    names: set[str] = set()
    for node in ast.parse(file.read_text()).body:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("mme_vla"):
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                names.add(inner if path_of(inner) else node.module)
    return names


def closure(modules: list[str]) -> list[Path]:
    """The files that these modules import, themselves included, packages without code aside."""
    done: set[str] = set()
    pending = [*modules]
    while pending:
        module = pending.pop()
        if module not in done and (file := path_of(module)) is not None:
            done.add(module)
            pending += imports(file)
    files = {file for module in done - NOT_READ if (file := path_of(module)) is not None}
    return sorted(file for file in files if len(file.read_text().splitlines()) > 1)


def check(files: list[Path]) -> list[Path]:
    """The files, each of which must exist."""
    if missing := [str(file) for file in files if not file.is_file()]:
        sys.exit(f"no such file: {', '.join(missing)}; update the lists in {Path(__file__).name}")
    return files


def defining(calls: list[tuple[str, str]]) -> list[Path]:
    """The files of (d), (f) or (g), each of which must define its call."""
    files = check([PACKAGE / name for name, _ in calls])
    for file, (_, call) in zip(files, calls, strict=True):
        functions = {
            node.name
            for node in ast.walk(ast.parse(file.read_text()))
            if isinstance(node, ast.FunctionDef)
        }
        if call not in functions:
            sys.exit(f"{file} defines no {call}(); update the lists in {Path(__file__).name}")
    return list(dict.fromkeys(files))


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
    """What (a) to (g) take, and the files."""
    lines, modules = example()
    sampled = defining(SAMPLING)
    trained = defining(TRAINING)
    evaluated = defining(EVALUATION)
    read = [closure(MODEL), *(check([PACKAGE / n for n in names]) for names in (SELECTION, HEAD))]
    return [
        *((count(files), files) for files in read),
        (f"{len(SAMPLING)} calls, {count(sampled)}", sampled),
        (f"{lines} lines, {modules} modules imported", [ROOT / ALONE]),
        (count(trained), trained),
        (count(evaluated), evaluated),
    ]


def main() -> None:
    """Print the table."""
    print("| question | to read | files |\n|---|---|---|")
    for question, (take, files) in zip(QUESTIONS, answers(), strict=True):
        names = ", ".join(f"`{file.relative_to(ROOT)}`" for file in files)
        print(f"| {question} | {take} | {names} |")


if __name__ == "__main__":
    main()
