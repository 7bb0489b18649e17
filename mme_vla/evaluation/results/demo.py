"""Made-up records with the paper's success rates, to try the results command without a robot or a checkpoint."""

import zlib
from collections.abc import Sequence

import numpy as np

from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord, Seconds
from mme_vla.evaluation.results import paper
from mme_vla.evaluation.results.scopes import MAX_STEPS, PAPER_ORDER, PAPER_SEEDS, TASK_FACTS

CHECKPOINTS = (60_000, 70_000, 79_999)
_LEVELS = ("easy", "easy", "medium", "hard")
_EASE = {"easy": 0.8, "medium": 0.0, "hard": -1.0}


def demo_records(
    methods: Sequence[tuple[str, str | None]],
    checkpoints: Sequence[int] = CHECKPOINTS,
    seeds: Sequence[int] = PAPER_SEEDS,
    episodes: int = 50,
) -> list[EpisodeRecord]:
    """Draw outcomes at random: right on average for the paper's per-task rates, and meaningless otherwise.

    An episode is as hard for every method, so that runs agree as real ones do.

    Args:
        methods: (model, subgoal predictor) pairs that the paper reports.
    """
    records = []
    for model, subgoal in methods:
        known = paper.paper_method(model, subgoal)
        if known is None:
            raise UserError(f"The paper does not report {model} with subgoals from {subgoal}.")
        for task, result in paper.per_task(known.name).items():
            number = PAPER_ORDER.index(task)
            levels = [_LEVELS[e % 4] for e in range(episodes)]
            ease = np.random.default_rng([number]).normal(scale=1.5, size=episodes) + [_EASE[level] for level in levels]
            chances = _chances(ease, result.mean / 100)
            for checkpoint in checkpoints:
                for seed in seeds:
                    rng = np.random.default_rng([zlib.crc32(known.name.encode()), number, checkpoint, seed])
                    for episode, won in enumerate(rng.random(episodes) < chances):
                        steps = int(TASK_FACTS[task].steps * rng.uniform(0.7, 1.1)) if won else MAX_STEPS
                        place = (model, checkpoint, seed, task, episode, 1000 * number + episode, levels[episode])
                        ended = ("success" if won else "timeout", steps)
                        time = Seconds(0.02 * steps, 0.01 * steps, 0.03 * steps)
                        records.append(EpisodeRecord(*place, *ended, time, subgoal=subgoal, extra={"made_up": True}))
    return records


def _chances(ease: np.ndarray, rate: float) -> np.ndarray:
    """Each episode's chance: a logistic of its ease, moved until the mean is `rate`."""
    low, high = -30.0, 30.0
    for _ in range(60):
        middle = (low + high) / 2
        chances = 1 / (1 + np.exp(-(ease + middle)))
        low, high = (middle, high) if chances.mean() < rate else (low, middle)
    return chances
