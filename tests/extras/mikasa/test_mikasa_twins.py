"""Twin accuracy in MIKASA-Robo-VLA of policies whose answer is known."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.planted import Planted, PlantedEpisode, Rule
from mme_vla.envs.base import environment
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.evaluation import RunOptions
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.probing.arms import UNPROBED
from mme_vla.extras.probing.twins import run_twins
from mme_vla.testing.small import small_policy


@pytest.mark.usefixtures("lamp_model", "cup_model")
@pytest.mark.parametrize(
    ("task", "episodes"),
    [
        ("RememberColor3", (0, 1)),
        pytest.param("ShellGameTouch", (0, 1), marks=pytest.mark.slow),
        # Others succeed as soon as the cup that fell has come up again.
        pytest.param("ShellGamePush", (0, 2), marks=pytest.mark.slow),
        pytest.param("ShellGameShuffleTouch", (0, 1), marks=pytest.mark.slow),
        pytest.param("ShellGameShuffleColorLampTouch", (0, 1), marks=pytest.mark.slow),
    ],
)
def test_only_what_knows_the_fact_is_right_in_both_scenes(
    task: str, episodes: Sequence[int], tmp_path: Path
) -> None:
    made: list[Any] = []

    def base(**scene: Any) -> Any:
        made.append(environment("mikasa").open(render=False, **scene))
        return made[-1]

    def towards(number: int | None) -> Rule:
        """The chunk that moves to a candidate, None for the correct one."""

        def rule(_: PlantedEpisode) -> np.ndarray:
            candidates, place = made[-1].candidates, made[-1].tool
            goal = candidates.places[candidates.correct[0] if number is None else number]
            gap = np.asarray(goal) - place
            row = np.zeros(7, np.float32)  # of eight equal steps, of 0.038 m at most
            row[:2] = gap / max(float(np.linalg.norm(gap)), 8 * 0.038)
            return np.tile(row, (8, 1))

        return rule

    options = RunOptions(show_progress=False, base=base)
    settings = RolloutSettings(env="mikasa", seed=7, execute=8)
    facts = RunKey("planted", "none", 7)
    for name, rule, expected in (("knows", towards(None), 1), ("always the first", towards(0), 0)):
        policy = Planted(small_policy("pi05", env="mikasa"), rule)
        jobs = [Job(task, "test", episode) for episode in episodes]
        twins = run_twins(policy, jobs, tmp_path / name, facts, settings, options)
        accuracy = twins.total[UNPROBED.name]
        assert (accuracy.pairs, accuracy.accuracy) == (2, expected), twins.notes
        assert accuracy.chance == pytest.approx(1 / 9)


@pytest.mark.slow
@pytest.mark.usefixtures("renderer", "lamp_model", "cup_model")
@pytest.mark.parametrize(
    "task", ["ShellGameTouch", "ShellGameShuffleTouch", "ShellGameShuffleColorLampTouch"]
)
def test_twins_of_cups_are_equal_once_a_decision_depends_on_the_fact(task: str) -> None:
    source = environment("mikasa")
    images = []
    for row in (None, source.twin(source.episode(task, "test", 1))):
        env = source.open(task, "test", 1, row=row)
        frames, _ = env.reset()
        observations = [frames]
        while env.candidates is None:
            observations.append(env.step(source.hold(env.env))[0])
        images.append([np.stack([frame[f"{camera}_rgb_list"][-1] for frame in observations])
                       for camera in ("top", "wrist")])  # fmt: skip
        env.close()
    for first, second in zip(*images, strict=True):
        assert first.shape == second.shape
        np.testing.assert_array_equal(first[-1], second[-1])
    top = images[0][0] != images[1][0]
    assert top.any(axis=(1, 2, 3)).sum() > 3, "the cue of both scenes is the same"
