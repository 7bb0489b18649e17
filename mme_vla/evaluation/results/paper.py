"""The paper's numbers, to put beside others, and synthetic records with its success rates."""

import csv
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.optimize import brentq
from scipy.special import expit

from mme_vla.evaluation.records import EpisodeRecord, Seconds
from mme_vla.evaluation.results.scopes import (
    MAX_STEPS,
    PAPER_ORDER,
    PAPER_SEEDS,
    TASK_FACTS,
    TEST_EPISODES,
)

FOLDER = Path(__file__).resolve().parents[2] / "assets" / "paper"


class PaperMethod(NamedTuple):
    """A method of the paper, and what it is here.

    name: as the data files spell it.
    label: as one writes it.
    model, subgoal: this library's names, None if it has none.
    family: none, symbolic, perceptual, recurrent or prior.
    """

    name: str
    label: str
    model: str | None
    subgoal: str | None
    family: str


class PaperResult(NamedTuple):
    """A success rate in percent and its standard deviation over the runs; None where the paper
    prints none.
    """

    mean: float
    std: float | None = None


def paper_table(name: str) -> list[dict[str, str]]:
    """Rows of one of the shipped files, by column."""
    text = (FOLDER / f"{name}.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


@cache
def paper_methods() -> dict[str, PaperMethod]:
    """Every method of the paper by its name."""
    methods = {}
    for row in paper_table("methods"):
        name = row["method"]
        model = row["model"] or None
        subgoal = row["subgoal"] or None
        methods[name] = PaperMethod(name, row["label"], model, subgoal, row["family"])
    return methods


def paper_method(model: str, subgoal: str | None = None) -> PaperMethod | None:
    """The paper's method that a model of this library is, or None."""
    for method in paper_methods().values():
        if (method.model, method.subgoal) == (model, subgoal):
            return method
    return None


@cache
def per_task(method: str) -> dict[str, PaperResult]:
    """A method's results on the 16 tasks."""
    results = {}
    for row in paper_table("per_task"):
        if row["method"] == method:
            result = PaperResult(float(row["success_mean"]), float(row["success_std"]))
            results[row["task"]] = result
    return {task: results[task] for task in PAPER_ORDER}


def average(method: str) -> PaperResult:
    """Mean over the 16 tasks, with the printed deviation where there is one."""
    printed = {row["method"]: float(row["average_std"]) for row in paper_table("suites")}
    return PaperResult(mean_over(method, PAPER_ORDER).mean, printed.get(method))


def mean_over(method: str, tasks: Sequence[str]) -> PaperResult:
    """Mean over some of the tasks."""
    results = per_task(method)
    return PaperResult(sum(results[task].mean for task in tasks) / len(tasks))


def chunk_flops() -> dict[str, float]:
    """FLOPs of a sampled chunk at full size, by model, as `python -m mme_vla.analyse cost` counted
    them.
    """
    counts = pd.read_csv(FOLDER.parent / "cost.csv", index_col="model")
    return counts["chunk"].astype(float).to_dict()


CHECKPOINTS = (60_000, 70_000, 79_999)
_LEVELS = ("easy", "easy", "medium", "hard")
_EASE = {"easy": 0.8, "medium": 0.0, "hard": -1.0}


def demo_records(methods: Sequence[tuple[str, str | None]]) -> list[EpisodeRecord]:
    """Draw outcomes at random: right on average for the paper's per-task rates, and meaningless
    otherwise.

    An episode is as hard for every method, so that runs agree as real ones do.

    methods: (model, subgoal predictor) pairs that the paper reports.
    """
    records = []
    for model, subgoal in methods:
        known = paper_method(model, subgoal)
        assert known is not None
        for task, result in per_task(known.name).items():
            number = PAPER_ORDER.index(task)
            levels = [_LEVELS[e % 4] for e in range(TEST_EPISODES)]
            ease = np.random.default_rng([number]).normal(scale=1.5, size=TEST_EPISODES)
            ease += [_EASE[level] for level in levels]
            chances = _chances(ease, result.mean / 100)
            for checkpoint in CHECKPOINTS:
                for seed in PAPER_SEEDS:
                    rng = np.random.default_rng(
                        [zlib.crc32(known.name.encode()), number, checkpoint, seed]
                    )
                    for episode, won in enumerate(rng.random(TEST_EPISODES) < chances):
                        outcome = "timeout"
                        steps = MAX_STEPS
                        if won:
                            outcome = "success"
                            steps = int(TASK_FACTS[task].steps * rng.uniform(0.7, 1.1))
                        record = EpisodeRecord(
                            model,
                            checkpoint,
                            seed,
                            task,
                            episode,
                            1000 * number + episode,
                            levels[episode],
                            outcome,
                            steps,
                            Seconds(0.02 * steps, 0.01 * steps, 0.03 * steps),
                            subgoal=subgoal,
                            made_up=True,
                        )
                        records.append(record)
    return records


def _chances(ease: np.ndarray, rate: float) -> np.ndarray:
    """Each episode's chance: a logistic of its ease, moved until the mean is `rate`."""
    mean = min(max(rate, 1e-9), 1 - 1e-9)  # which a logistic can have
    shift = brentq(lambda shift: expit(ease + shift).mean() - mean, -50, 50)
    return expit(ease + shift)
