"""Variants of the test split: at zero the official scenes, beyond it the same scenes with more."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import built, wait
from mme_vla.envs import metadata
from mme_vla.envs.make import make_env
from mme_vla.envs.metadata import DIALS
from mme_vla.envs.subtasks import number, ordinal
from mme_vla.envs.task import Task
from mme_vla.errors import UserError

PAIRS = [(dial, task) for dial, tasks in DIALS.items() for task in tasks]
STEPS = 3


def scene(env: Task) -> dict[str, np.ndarray]:
    """Where everything stands, and what the script will do."""
    places = {thing.name: np.concatenate([thing.pose.p, thing.pose.q]) for thing in env.things}
    texts = [subtask.text for subtask in env.progress.subtasks] + env.goals()
    return {**places, "texts": np.array(texts)}


@pytest.mark.parametrize(("dial", "task"), PAIRS)
def test_at_zero_a_dial_changes_nothing_and_beyond_it_the_scene_stays(dial: str, task: str) -> None:
    assert (
        metadata.episodes(task, f"stress:{dial}=0")[7].seed
        == metadata.episodes(task, "test")[7].seed
    )
    scenes = {}
    for turned in (None, 0, 2):
        env = built(task, stress=None if turned is None else {dial: turned})
        wait(env, STEPS)
        homes = {
            thing.name: np.concatenate([thing.initial_pose.p, thing.initial_pose.q])
            for thing in env.things
        }
        scenes[turned] = scene(env), homes, len(env.progress.subtasks)
        env.close()
    (official, places, steps), (at_zero, _, _), (_, more, more_steps) = scenes.values()
    assert official.keys() == at_zero.keys()
    assert all(np.array_equal(official[name], at_zero[name]) for name in official)
    assert [name for name in places if not np.array_equal(places[name], more[name])] == []
    if dial in ("containers", "distractors"):
        assert len(more) == len(places) + 2
    if dial == "count" and task != "StopCube":
        assert more_steps > steps


def test_what_a_dial_changes_is_present_in_the_stated_number() -> None:
    for task, attribute in (
        ("PickXtimes", "repetitions"),
        ("SwingXtimes", "repetitions"),
        ("StopCube", "visit"),
        ("VideoUnmaskSwap", "swap_count"),
    ):
        dial = "swaps" if "Swap" in task else "count"
        scenes = [built(task, stress={dial: turned}) for turned in (0, 12)]
        original, more = (getattr(env, attribute) for env in scenes)
        assert more == original + 12
        for env in scenes:
            env.close()
    assert (ordinal(9), ordinal(11), ordinal(20), number(10), number(12)) == (
        "tenth",
        "12th",
        "21st",
        "ten",
        "12",
    )
    original, late = built("VideoUnmask"), built("VideoUnmask", stress={"delay": 40})
    static = [env.progress.subtasks[0].done for env in (original, late)]
    for env, done, steps in zip((original, late), static, (64, 104), strict=True):
        while not done() and env.steps_done < 200:
            wait(env)
        assert env.steps_done == pytest.approx(steps, abs=4)
        env.close()


def test_an_environment_of_a_variant_is_made_by_its_split() -> None:
    env: Any = make_env("PickXtimes", "stress:count=3", 0, render=False)
    assert env.task.repetitions == built("PickXtimes", 0).repetitions + 3
    env.close()
    env = make_env("VideoPlaceButton", "twin", 0, render=False)
    assert env.task.in_view
    env.close()


@pytest.mark.parametrize(
    ("task", "split", "words"),
    [
        ("PickXtimes", "stress", "say which dial is turned how far, as stress:count=2"),
        ("PickXtimes", "stress:counts=2", "there is no dial 'counts'. Did you mean 'count'"),
        ("PickXtimes", "stress:swaps=2", "PickXtimes has no dial 'swaps'; it has count"),
        ("PickXtimes", "twin:twin", "name twin once, as twin:test"),
        ("PickXtimes", "twin:twin:hard", "name twin once, as twin:hard"),
        ("BinFill", "tset", "Unknown split 'tset'. Did you mean 'test'?"),
    ],
)
def test_variants_that_there_are_not_are_reported(task: str, split: str, words: str) -> None:
    with pytest.raises(UserError) as caught:
        metadata.episodes(task, split)
    assert words in str(caught.value)


def test_a_task_refuses_a_dial_that_it_does_not_have() -> None:
    with pytest.raises(UserError, match="cannot turn 'swaps'"):
        built("PickXtimes", stress={"swaps": 1})
