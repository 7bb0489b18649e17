"""A saved state continues as if nothing had been between, and rewards add up to what was done."""

import pickle
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from mme_vla.envs import make_env
from mme_vla.envs.base import Hold
from mme_vla.envs.interface import RoboMMEEnv
from mme_vla.envs.subtasks import Progress, SubTask
from mme_vla.errors import UserError
from mme_vla.registry import REWARDS


def joints(env: RoboMMEEnv, k: int) -> np.ndarray:
    action = np.array(env.task.reset_action, np.float32)
    action[:7] += 0.08 * np.sin(0.15 * k + np.arange(7))
    return action


def resume(env: RoboMMEEnv, actions: list[Any]) -> list[Any]:
    """Everything that an environment says and is, after each of these actions."""
    observations = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        state = env.task.get_state().cpu().numpy()
        observations.append(
            (
                observation,
                float(reward),
                bool(terminated),
                bool(truncated),
                info,
                state,
                env.steps_counted,
            )
        )
    return observations


def same(one: Any, other: Any) -> bool:
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return bool(np.array_equal(one, other)) if isinstance(one, np.ndarray) else bool(one == other)


# A task with a video and scripted motion, and one whose choices are planned motions that end in a
# grasp; a tally of its twin goes down.
CASES = [
    ("VideoUnmaskSwap", "test", "joint_angle", [None] * 12, [None] * 8),
    (
        "PickXtimes",
        "twin",
        "multi_choice",
        [{"choice": "a", "point": [94, 110]}],
        [{"choice": "b"}, {"choice": "c"}],
    ),
    ("StopCube", "test", "joint_angle", [None] * 3 + [Hold(6)], [Hold(4), *[None] * 2]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("task", "split", "space", "before", "after"), CASES)
def test_a_restored_episode_goes_on_to_the_last_bit(
    task: str, split: str, space: str, before: list[Any], after: list[Any]
) -> None:
    env = make_env(task, split, 3, space, render=False, reward="subtask")
    assert isinstance(env, RoboMMEEnv)
    first, last = [
        [joints(env, k) if a is None else a for k, a in enumerate(some)] for some in (before, after)
    ]
    env.reset()
    reached = resume(env, first)[-1]
    state = env.save_state()
    expected = resume(env, last)
    frames: list[Any] = []
    env.on_frame = lambda *frame: frames.append(frame)
    observation, info = env.restore_state(state)
    assert same(observation, reached[0]) and same(info, reached[4]) and frames == []
    assert np.array_equal(env.task.get_state().cpu().numpy(), reached[5])
    assert same(resume(env, last), expected) and frames
    env.close()
    fresh = make_env(task, split, 3, space, render=False, reward="subtask")
    assert isinstance(fresh, RoboMMEEnv)
    fresh.restore_state(pickle.loads(pickle.dumps(state)))
    assert same(resume(fresh, last), expected), (
        "another environment, in another process for all it knows"
    )
    fresh.close()


@pytest.mark.usefixtures("renderer")
def test_the_newest_frame_is_rendered_and_the_request_stays_what_it_was() -> None:
    env = make_env("PickXtimes", "test", 0)
    assert isinstance(env, RoboMMEEnv)
    env.reset()
    reached = resume(env, [joints(env, k) for k in range(3)])[-1]
    state = env.save_state()
    after = resume(env, [joints(env, 3)])
    observation, info = env.restore_state(state)
    assert same(observation, reached[0]) and same(info, reached[4]) and env.render_request is None
    assert same(resume(env, [joints(env, 3)]), after)
    env.close()


def test_a_state_survives_later_steps_and_fits_its_scene_only() -> None:
    env = make_env("PickXtimes", "test", 0, render=False)
    assert isinstance(env, RoboMMEEnv)
    with pytest.raises(UserError, match="reset"):
        env.save_state()
    env.reset()
    state = env.save_state()
    action = joints(env, 0)
    env.step(action)
    later_state = env.save_state()
    action[:] = 0  # what was given may be used again
    assert state.actions == () and len(later_state.actions) == 1 and later_state.actions[0].any()
    env.close()
    for split, episode, differs in (
        ("test", 1, r"seed \d+ \(here \d+\)"),
        ("twin", 0, r"in_view False \(here True\)"),
        ("stress:count=2", 0, r"stress {} \(here {'count': 2}\)"),
    ):
        other = make_env("PickXtimes", split, episode, render=False)
        assert isinstance(other, RoboMMEEnv)
        with pytest.raises(UserError, match=f"another environment: {differs}"):
            other.restore_state(state)
        other.close()


# Rewards ------------------------------------------------------------------------------------------


def test_rewards_are_shares_of_the_executions_subtasks() -> None:
    steps = [SubTask("x", done=lambda: True, run=lambda _: None, video=i < 1) for i in range(5)]
    progress = Progress(steps, latch_failure=False)
    rewards = []
    for _ in range(6):
        rewards.append(
            [REWARDS[name](progress, progress.succeeded) for name in ("none", "sparse", "subtask")]
        )
        progress.update()
    assert [row[0] for row in rewards] == [0] * 6 and [row[1] for row in rewards] == [0] * 5 + [1]
    assert [row[2] for row in rewards] == [0, 0, 0.25, 0.5, 0.75, 1]


def test_an_episode_that_is_done_has_earned_one_and_the_benchmarks_none() -> None:
    with pytest.raises(UserError, match="Unknown reward 'dense'"):
        make_env("PickXtimes", "test", 0, render=False, reward="dense")
    totals = {}
    for reward in REWARDS:
        env = make_env("StopCube", "test", 0, "multi_choice", render=False, reward=reward)
        assert isinstance(env, RoboMMEEnv)
        env.reset()
        rewards = []
        for letter in ["a", *["b"] * len(env.task.checkpoints()), "c"]:
            _, earned, ended, _, info = env.step({"choice": letter})
            rewards.append(float(earned))
            if ended:
                break
        env.close()
        assert info["status"] == "success"
        totals[reward] = rewards
    assert sum(totals["none"]) == 0 and sum(totals["sparse"]) == totals["sparse"][-1] == 1
    assert sum(totals["subtask"]) == pytest.approx(1) and all(
        share > 0 for share in totals["subtask"]
    )
