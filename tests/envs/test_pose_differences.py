"""Actions that are differences to the tool's pose at their own step: converted, learned, executed
and served.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.h5_files import pose_at, robomme_robot, tool_at
from helpers.prior_vla_runs import run
from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from helpers.scripted_env import ScriptedEnv
from helpers.serving_fakes import Served, challenge
from mme_vla import UserError
from mme_vla.data.episodes import EpisodeSource
from mme_vla.embodiment import Embodiment
from mme_vla.envs.vector.pool import Job
from mme_vla.policy.base import Policy

NAME = "robomme_ee_delta"


def expected(number: int) -> np.ndarray:
    """What is in the files: `tool_at` is so far short of `pose_at`, and a whole turn
    away in roll.
    """
    lag = [0.01, -0.02, 0.001 * number, 0.05, 0.1, -0.1]
    return np.array([*lag, pose_at(number)[6]])


def test_differences_are_to_each_steps_pose_by_the_shorter_way(folder: Path) -> None:
    source = EpisodeSource(folder, robot=robomme_robot(NAME))
    actions = source.actions(0)
    np.testing.assert_allclose(actions, [expected(t) for t in range(24)], atol=1e-5)
    assert source.actions(0, 5, 7).tolist() == actions[5:7].tolist()
    assert abs(pose_at(3)[3] - tool_at(3)[3]) > np.pi, "or there is no turn to be left out"


def test_past_the_end_nothing_moves_and_the_gripper_stays(folder: Path) -> None:
    chunk, recorded = EpisodeSource(folder, robot=robomme_robot(NAME)).action_chunk(
        0, 20, 6, offset=1
    )
    assert recorded.tolist() == [True] * 3 + [False] * 3
    np.testing.assert_allclose(chunk[:3], [expected(t) for t in (21, 22, 23)], atol=1e-5)
    assert not chunk[3:, :6].any() and (chunk[3:, 6] == expected(23)[6]).all()


def test_an_embodiment_says_which_numbers_they_are_and_keeps_it(folder: Path) -> None:
    panda = robomme_robot(NAME)
    assert Embodiment.from_dict(panda.to_dict()) == panda and panda.action.of_pose == tuple(
        range(6)
    )
    assert (panda.action.space, panda.action.answers) == ("ee_pose", "ee_delta")
    assert (
        "of_pose"
        not in replace(panda, action=replace(panda.action, of_pose=(), pose_key=())).to_dict()[
            "action"
        ]
    )
    for words in (["embodiment.action.pose_key=null"], ["embodiment.action.frames=null"]):
        with pytest.raises(UserError, match="of_pose"):
            robomme_robot(NAME, *words)
    with pytest.raises(UserError, match="lacks the feature eef_state"):
        EpisodeSource(
            "sample", robot=replace(panda, action=replace(panda.action, key=("actions",)))
        )


def test_memoryvla_learns_them_and_is_executed_from_where_the_tool_is(
    folder: Path, tmp_path: Path
) -> None:
    small = [
        "backbone.vision.image_size=28",
        "processor.group_size=3",
        "train.batch_size=2",
        "backbone.head.depth=1",
    ]
    words = [
        f"embodiment={NAME}",
        f"data.sources=[{folder}]",
        "data.val_episodes=[1]",
        "train.steps=1",
    ]
    policy = Policy.from_pretrained(run("memoryvla", tmp_path / "run", *small, *words))
    panda = policy.embodiment
    assert (panda.name, panda.action.horizon, panda.action.execute, policy.action_dim) == (
        NAME,
        16,
        8,
        7,
    )
    stats = policy.require_processor().require_stats().actions
    exact = np.array([expected(t) for t in range(24)])
    np.testing.assert_allclose(stats.max[:6], exact[:, :6].max(0), atol=1e-5)
    envs = InlineEnvs(robot=panda, base=make_posed_env)
    (record,) = roll(policy, [Job("VideoUnmask", "test", 1)], envs, max_steps=1300)
    env = envs.made[Job("VideoUnmask", "test", 1)]
    assert record.action_space == "ee_delta" and len(env.actions) == record.steps > 8
    sent, stood = np.stack(env.actions), np.stack(env.poses[: len(env.actions)])
    low, high = stats.min[:6] - 1e-5, stats.max[:6] + 1e-5
    assert ((sent[:, :6] - stood >= low) & (sent[:, :6] - stood <= high)).all(), (
        "each beside its own step's pose"
    )
    assert (np.abs(stood).max(0) > 10 * np.abs(high)).all() and set(np.unique(sent[:, 6])) <= {
        -1.0,
        1.0,
    }


class PosedEnv(ScriptedEnv):
    """Says where the tool is: somewhere else at every frame, far from where any
    difference leads.
    """

    def _lists(self, frames: list[dict[str, Any]]) -> dict[str, Any]:
        rng = np.random.default_rng(len(self.frames))
        poses = [rng.uniform(50, 90, 6) for _ in frames]
        self.poses = [*getattr(self, "poses", []), poses[-1]]
        return super()._lists(frames) | {"eef_state_list": poses}


def make_posed_env(task: str, split: str, episode: int, max_steps: int, **options: Any) -> PosedEnv:
    return PosedEnv(task, episode, max_steps, 1e9, 0.0, "")


def test_an_environment_that_does_not_tell_poses_is_refused_by_name() -> None:
    policy = quick_policy("pi05", embodiment=NAME)
    with pytest.raises(
        UserError, match="differences to 'eef_state', which this environment does not deliver"
    ):
        roll(
            policy, [Job("PickXtimes", "test", 0)], InlineEnvs(robot=policy.embodiment), max_steps=3
        )


def test_a_client_must_say_that_it_adds_the_pose() -> None:
    policy = quick_policy("pi05", embodiment=NAME)
    frames, states = [np.zeros((32, 32, 3), np.uint8)] * 2, np.zeros((2, 8), np.float32)
    request = challenge(frames, frames, states, True)
    with Served(policy) as served:
        with served.client() as client:
            assert client.metadata["action_space"] == "ee_delta"
            assert client.infer({**request, "action_space": "ee_delta"})["actions"].shape == (16, 7)
        for state, reason in (
            (request, "send action_space='ee_delta'"),
            (request | {"action_space": "ee_pose"}, "ee_delta only"),
        ):
            with served.client() as client, pytest.raises(UserError, match=reason):
                client.infer(state)
