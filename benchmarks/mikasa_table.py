"""Memories on MIKASA-Robo-VLA with two CPU cores, by choices: one small policy a memory for all
tasks. Success, twin accuracy, and what of the facts each memory stored and updated, in
`<output>/table.csv`.

python benchmarks/mikasa_table.py --output outputs/mikasa24
python benchmarks/mikasa_table.py --output outputs/unit --tasks RememberColor3
--models framesamp_modul --seeds 1 --steps 20 --episodes 1 --pairs 1

The same command continues an interrupted run. Rows are added when a training has been evaluated.
Of a table without gaps, such as the published one, it prints means and rank correlations:

python scripts/published.py unpack mikasa24
python benchmarks/mikasa_table.py --output outputs/published/mikasa24
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from mme_vla.errors import check_known, counted
from mme_vla.evaluation.results.baselines import missing_baselines
from mme_vla.evaluation.results.scopes import PAPER_ORDER
from mme_vla.evaluation.results.statistics import percentiles, resampled_means
from mme_vla.evaluation.store import read_folders
from mme_vla.extras.mikasa.catalog import FAMILY_OF, STEPS
from mme_vla.extras.nano.board import Board, published_success, spearman
from mme_vla.extras.nano.cli.board import published_rows
from mme_vla.extras.nano.rows import CHOICES, read_rows, table_of
from mme_vla.utils import write_atomically

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from benchmarks.mikasa_tower import BACKBONE, ENV, make_tower, save_initial_policy

MOST_STEPS = 180
"""Steps of an episode, of tasks whose own limit is longer: 40 demonstrations of each have 83 to 117
of three cubes, and 117 to 176 of five.
"""
TASKS = (
    "RememberColor3", "RememberColor5", "RememberColor9",
    "RememberShape3", "RememberShape5", "RememberShape9",
    "RememberShapeAndColor3x2", "RememberShapeAndColor3x3", "RememberShapeAndColor5x3",
    "FindImposterColor3", "FindImposterColor5", "FindImposterColor9",
    "FindImposterShape3", "FindImposterShape5", "FindImposterShape9",
    "FindImposterShapeAndColor3x2", "FindImposterShapeAndColor3x3", "FindImposterShapeAndColor5x3",
    "TakeItBack", "BunchOfColors3", "BunchOfColors5", "SeqOfColors3", "ChainOfColors3",
    "ChainOfColors5",
)  # fmt: skip
TOWER_TASKS = (
    "RememberColor9", "RememberShape9", "RememberShapeAndColor5x3", "FindImposterColor9",
    "FindImposterShape9", "FindImposterShapeAndColor5x3", "TakeItBack", "BunchOfColors3",
    "SeqOfColors3",
)  # fmt: skip
"""Whose renders the vision tower learns from: they show every colour, shape and place."""
ONE_TOKEN = ("memory.budget=16", "memory.grid=1")  # sixteen frames of one token each
EVERY_FRAME = (*ONE_TOKEN, "memory.stride=1")
MODELS: Mapping[str, Sequence[str]] = {
    "framesamp_modul": ONE_TOKEN,
    "tokendrop_modul": EVERY_FRAME,
    "ttt_modul": EVERY_FRAME,
    "events_modul": EVERY_FRAME,
    "actions_modul": ("memory.budget=16",),
    "present_modul": ("memory.grid=1", "memory.positions=space"),
    "pi05": (),
}
"""Model → the settings of its memory, of sixteen tokens at most. All that read images read every
frame, so that one vision cache serves them.
"""
SELECTING = ("framesamp_modul", "tokendrop_modul", "events_modul", "present_modul")
"""Models whose memory keeps frames, so that storage and update are defined."""
TRAINING = (
    "train.batch_size=16",
    "train.lr=1e-3",
    "train.schedule=cosine",
    "train.save_every=200",
    "train.val_samples=0",
    "train.open_loop_chunks=0",
    "data.cache.max_build_frames=1000000",
    "train.workers=0",
    "logger=none",
)
COLUMNS = (
    "model", "seed", "task", "memory", "successes", "episodes",
    "twin_accuracy", "twin_pairs", "twin_chance", "storage", "update",
)  # fmt: skip
Run = Callable[[Sequence[str]], None]
"""Runs a command of the library, given its words."""


def run_command(words: Sequence[str], threads: int) -> None:
    """Run a command in a process of its own with this many threads."""
    print("mme-vla", *words, flush=True)
    variables = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    subprocess.run([sys.executable, "-m", "mme_vla", *words], check=True, env=variables)


def read_table(path: Path) -> list[dict[str, str]]:
    """The rows so far."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write all rows in one step, so that none is ever cut off; by seed, model and task."""
    models, tasks = list(MODELS), list(STEPS)
    rows = sorted(
        rows,
        key=lambda row: (int(row["seed"]), models.index(row["model"]), tasks.index(row["task"])),
    )
    with write_atomically(path) as draft, draft.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def measure(args: argparse.Namespace, run: Run | None = None) -> list[dict[str, str]]:
    """Carry out what the output lacks: demonstrations, then each training and what is measured of
    it, `jobs` of them at a time.

    Returns:
        The rows of the table.
    """
    for task in args.tasks:
        check_known("task in --tasks:", task, FAMILY_OF)
    for model in args.models:
        check_known("model in --models:", model, MODELS)
    if run is None:
        run = partial(run_command, threads=max(1, (os.cpu_count() or 1) // args.jobs))
    folder: Path = args.output
    folder.mkdir(parents=True, exist_ok=True)
    table = folder / "table.csv"
    known = {(row["model"], row["seed"], row["task"]) for row in read_table(table)}
    units: list[tuple[str, int, Sequence[str]]] = []
    for seed in range(args.seeds):
        for model in args.models:
            tasks = [task for task in args.tasks if (model, str(seed), task) not in known]
            if tasks:
                units.append((model, seed, tasks))
    if not units:
        return read_table(table)

    missing = [task for task in args.tasks if not recording(folder, task).is_dir()]
    with ThreadPoolExecutor(args.jobs) as pool:
        list(pool.map(partial(_record, args=args, run=run), missing))
    seeds = [seed for seed in range(args.seeds) if not initial_policy(folder, seed).is_dir()]
    if seeds:
        place = folder / "tower"
        tower = make_tower(TOWER_TASKS, place, args.scenes, args.tower_steps, args.jobs)
        for seed in seeds:
            save_initial_policy(tower, initial_policy(folder, seed), seed)

    with ThreadPoolExecutor(args.jobs) as pool:
        futures = [pool.submit(_rows_of, unit, args, run) for unit in units]
        try:
            for future in as_completed(futures):
                write_table(table, [*read_table(table), *future.result()])
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # what has not begun
            raise
    return read_table(table)


def recording(folder: Path, task: str) -> Path:
    """Where the demonstrations of a task are."""
    return folder / "demonstrations" / task


def initial_policy(folder: Path, seed: int) -> Path:
    """Where the policy is from which the trainings of a seed begin."""
    return folder / "tower" / f"policy-{seed}"


def _record(task: str, args: argparse.Namespace, run: Run) -> None:
    words = [f"episodes={args.demonstrations}", f"output={recording(args.output, task)}"]
    run(["record", f"env={ENV}", _key([task]), *words])


def _key(tasks: Sequence[str]) -> str:
    return f"tasks=[{','.join(tasks)}]"


def _rows_of(
    unit: tuple[str, int, Sequence[str]], args: argparse.Namespace, run: Run
) -> list[dict[str, Any]]:
    """Train a policy, as far as it is not, and measure it.

    Args:
        unit: model, seed, and the tasks whose rows the table lacks.

    Returns:
        A row for each of these tasks.
    """
    model, seed, missing = unit
    folder: Path = args.output
    data = ",".join(str(recording(folder, task)) for task in args.tasks)
    name = f"{model}/{seed}"
    training = folder / "training" / name
    if not (training / "summary.json").is_file():
        words = [f"model={model}", *MODELS[model], *TRAINING]
        words += [f"init_from={initial_policy(folder, seed)}", f"seed={seed}"]
        words += [f"train.steps={args.steps}", "resume=auto", f"output={training}"]
        run(["train", f"env={ENV}", f"data.sources=[{data}]", *BACKBONE, *words])

    # Both continue what an interruption left, and repeat nothing.
    closed_loop = [f"env={ENV}", f"checkpoint={training}"]
    evaluated = folder / "evaluation" / name
    episodes = [f"episodes={args.episodes}", "workers=1"]
    # `max_steps` takes the place of a task's own limit: tasks that keep theirs run separately.
    shorter = [task for task in args.tasks if STEPS[task] <= args.most_steps]
    longer = [task for task in args.tasks if STEPS[task] > args.most_steps]
    if shorter:
        output = f"output={evaluated / 'own_limit'}"
        run(["evaluate", *closed_loop, _key(shorter), *episodes, output])
    if longer:
        limit = f"max_steps={args.most_steps}"
        output = f"output={evaluated / 'shortened'}"
        run(["evaluate", *closed_loop, _key(longer), *episodes, limit, output])
    twins = folder / "twins" / name
    pairs = f"episodes={args.pairs}"
    run(["probe", "twins", *closed_loop, _key(args.tasks), pairs, f"output={twins}"])

    # A memory that keeps frames keeps the same ones whatever it has learned: once for all seeds.
    writing = folder / "writing" / f"{model}.json"
    is_measured = model in SELECTING and seed == 0
    if is_measured and not writing.is_file():
        run([
            "analyse", "writing", "--env", ENV, "--checkpoint", str(training), "--memories",
            "--tasks", ",".join(args.tasks), "--episodes", str(args.demonstrated),
            "--output", str(writing),
        ])  # fmt: skip

    successes: dict[str, list[bool]] = {}
    for record in read_folders(sorted(evaluated.rglob("episodes*.jsonl"))):
        successes.setdefault(record.task, []).append(record.success)
    accuracies = json.loads((twins / "twins.json").read_text())["tasks"]
    stored: dict[str, Any] = {}
    if is_measured:
        stored = next(iter(json.loads(writing.read_text()).values()))["tasks"]
    rows = []
    for task in missing:
        twin: dict[str, Any] = next(iter(accuracies.get(task, {}).values()), {})
        of_facts = stored.get(task, {})
        rows.append(
            {
                "model": model,
                "seed": seed,
                "task": task,
                "memory": FAMILY_OF[task].memory,
                "successes": sum(successes[task]),
                "episodes": len(successes[task]),
                "twin_accuracy": twin.get("accuracy"),
                "twin_pairs": twin.get("pairs"),
                "twin_chance": twin.get("chance"),
                "storage": of_facts.get("storage"),
                "update": of_facts.get("update"),
            }
        )
    return rows


def summary(rows: Sequence[Mapping[str, str]]) -> str:
    """Means over the rows of each model that have a value, in Markdown."""
    lines = [
        "| model | rows | success | twins | storage | update |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    models = list(dict.fromkeys(row["model"] for row in rows))
    for model in models:
        of_model = [row for row in rows if row["model"] == model]
        shares = [int(row["successes"]) / int(row["episodes"]) for row in of_model]
        cells = [f"{sum(shares) / len(shares):.3f}"]
        for column in ("twin_accuracy", "storage", "update"):
            values = [float(row[column]) for row in of_model if row[column]]
            cells.append(f"{sum(values) / len(values):.3f}" if values else "")
        lines.append(f"| {model} | {len(of_model)} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", *agreements(rows), *missing_baselines(models)])


def agreements(rows: Sequence[Mapping[str, str]], samples: int = 2000) -> list[str]:
    """Sentences with the rank correlation of success and of twin accuracy with nanoMME-16 and with
    the paper, over the models that both have; tasks are resampled for the intervals.
    """
    shipped = published_rows(table_of("further", CHOICES))
    assert shipped is not None
    board = Board(read_rows([shipped]), samples=1)
    references: dict[str, dict[str, float]] = {"nanoMME-16": {}, "the paper": {}}
    for row in board.rows:
        references["nanoMME-16"][row.name] = board.success(row)
        if row.paper is not None:
            references["the paper"][row.name] = published_success(row.paper, PAPER_ORDER)

    table = pd.DataFrame(rows)
    for column in ("successes", "episodes", "twin_accuracy"):
        table[column] = pd.to_numeric(table[column])
    table["success"] = table["successes"] / table["episodes"]
    sentences = []
    for measure_name, column in (("success", "success"), ("twin accuracy", "twin_accuracy")):
        by_task = table.pivot_table(column, "task", "model").dropna()  # means over trainings
        for name, known in references.items():
            common = [model for model in by_task.columns if model in known]
            if len(common) < 3 or by_task.empty:
                continue
            values = by_task[common].to_numpy()
            published = np.array([known[model] for model in common])
            draws = resampled_means({"": list(values.T)}, samples, seed=0).round(9)
            low, high = percentiles(spearman(draws.T, published))
            models, tasks = counted(len(common), "model"), counted(len(values), "task")
            correlation = spearman(values.mean(axis=0), published)
            sentences.append(
                f"Rank correlation of {measure_name} with {name}, {models} and {tasks}:"
                f" {correlation:.2f} [{low:.2f}, {high:.2f}]."
            )
    return sentences


def main(words: Sequence[str] | None = None) -> None:
    """Measure what is missing, and print the means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=list(TASKS))
    parser.add_argument("--models", nargs="+", default=list(MODELS))
    parser.add_argument("--seeds", type=int, default=2, help="trainings of each model")
    parser.add_argument("--demonstrations", type=int, default=40, help="of each task")
    parser.add_argument("--scenes", type=int, default=150, help="of each task for the vision tower")
    parser.add_argument("--tower-steps", type=int, default=400, help="updates of the vision tower")
    parser.add_argument("--steps", type=int, default=800, help="updates of a training")
    parser.add_argument("--episodes", type=int, default=10, help="test scenes of each task")
    parser.add_argument("--pairs", type=int, default=1, help="pairs of twins of each task")
    parser.add_argument(
        "--demonstrated", type=int, default=2, help="of each task, whose stored facts are counted"
    )
    parser.add_argument("--most-steps", type=int, default=MOST_STEPS, help="of an episode")
    parser.add_argument("--jobs", type=int, default=2, help="trainings or measurements at a time")
    print(summary(measure(parser.parse_args(words))))


if __name__ == "__main__":
    main()
