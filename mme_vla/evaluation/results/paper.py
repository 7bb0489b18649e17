"""The paper's numbers, to put beside one's own."""

import csv
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path
from typing import NamedTuple

from mme_vla.errors import UserError, did_you_mean
from mme_vla.evaluation.results.scopes import PAPER_ORDER, TASK_FACTS

FOLDER = Path(__file__).resolve().parents[2] / "assets" / "paper"


class PaperMethod(NamedTuple):
    """A method of the paper, and what it is here.

    name: as the data files spell it. label: as one writes it.
    model, subgoal: this library's names, None if it has none. family: none, symbolic, perceptual, recurrent or prior.
    """

    name: str
    label: str
    model: str | None
    subgoal: str | None
    family: str


class PaperResult(NamedTuple):
    """A success rate in percent and its standard deviation over the runs; None where the paper prints none."""

    mean: float
    std: float | None = None


def paper_table(name: str) -> list[dict[str, str]]:
    """Rows of one of the shipped files, by column."""
    path = FOLDER / f"{name}.csv"
    if not path.is_file():
        raise UserError(f"No table {name!r} of the paper. {did_you_mean(name, [f.stem for f in FOLDER.glob('*.csv')])}")
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@cache
def paper_methods() -> dict[str, PaperMethod]:
    """Every method of the paper by its name."""
    rows = paper_table("methods")
    return {
        row["method"]: PaperMethod(
            row["method"], row["label"], row["model"] or None, row["subgoal"] or None, row["family"]
        )
        for row in rows
    }


def paper_method(model: str, subgoal: str | None = None) -> PaperMethod | None:
    """The paper's method that a model of this library is, or None."""
    return next((m for m in paper_methods().values() if (m.model, m.subgoal) == (model, subgoal)), None)


@cache
def per_task(method: str) -> dict[str, PaperResult]:
    """A method's results on the 16 tasks."""
    rows = {
        row["task"]: PaperResult(float(row["success_mean"]), float(row["success_std"]))
        for row in paper_table("per_task")
        if row["method"] == method
    }
    if not rows:
        raise UserError(f"The paper has no results of {method!r}. {did_you_mean(method, paper_methods())}")
    return {task: rows[task] for task in PAPER_ORDER}


def average(method: str) -> PaperResult:
    """Mean over the 16 tasks, with the printed deviation where there is one."""
    printed = {row["method"]: float(row["average_std"]) for row in paper_table("suites")}
    return PaperResult(_mean(method, PAPER_ORDER), printed.get(method))


def suite_mean(method: str, suite: str) -> PaperResult:
    """Mean over the tasks of a suite."""
    return PaperResult(_mean(method, [t.name for t in TASK_FACTS.values() if t.suite == suite]))


def group_mean(method: str, group: str) -> PaperResult:
    """Mean over the tasks of a functional group."""
    return PaperResult(_mean(method, [t.name for t in TASK_FACTS.values() if t.group == group]))


def _mean(method: str, tasks: list[str] | tuple[str, ...]) -> float:
    results = per_task(method)
    if not tasks:
        raise UserError("No task of this name: see SUITES and GROUPS of mme_vla.evaluation.results.scopes.")
    return sum(results[task].mean for task in tasks) / len(tasks)


REPLAN = 16
"""Frames that pass between two chunks of an episode."""
_COUNTED = Path(__file__).resolve().parents[2] / "assets" / "cost.csv"


@dataclass(frozen=True)
class ModelCost:
    """One model's cost; all but `prompt` (tokens) and `parameters` in FLOPs.

    forward: the loss of one training sample. chunk: memory, prefix and ten Euler steps. memory: of these, encoding the
    memory tokens from scratch. streamed: instead, a recurrent memory's update by one frame (None for others). frames:
    the vision tower on those of `REPLAN` passing frames that the memory stores.
    """

    model: str
    prompt: int
    parameters: int
    forward: int
    chunk: int
    memory: int
    streamed: int | None
    frames: int


@cache
def counted() -> dict[str, ModelCost]:
    """The shipped counts of every model at full size, made by `python -m mme_vla.analyse cost`."""
    with _COUNTED.open(newline="") as file:
        rows = list(csv.DictReader(file))
    numbers = [{key: int(text) if text else None for key, text in row.items() if key != "model"} for row in rows]
    return {row["model"]: ModelCost(row["model"], **of) for row, of in zip(rows, numbers, strict=True)}  # type: ignore


def chunk_flops() -> dict[str, float]:
    """FLOPs of a sampled chunk at full size, by model."""
    return {model: float(cost.chunk) for model, cost in counted().items()}


def write_costs(costs: list[ModelCost], path: Path) -> None:
    """Write counts as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [member.name for member in fields(ModelCost)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(cost) for cost in costs)
