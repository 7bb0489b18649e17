"""SAM2Act+ in a rollout: depth and poses of cameras come along, one waypoint is one motion of many frames."""

from typing import Any

import numpy as np
import pytest
import torch

from helpers.rollout_fakes import InlineEnvs, roll
from helpers.scripted_env import ScriptedEnv
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout.environment import ChunkEnv
from mme_vla.methods.sam2act.policy import SAM2ActPolicy
from mme_vla.policy.build import build_policy

MOTION, SIZE = 40, 64
DOWN = np.array([[0, -1, 0, 0.0], [-1, 0, 0, 0.0], [0, 0, -1, 1.0]], np.float32)


class MotionEnv(ScriptedEnv):
    """Moves for `MOTION` frames a waypoint, sees with depth, and succeeds after three motions."""

    def __init__(self, task: str, episode: int, blind: bool = False) -> None:
        super().__init__(task, episode, 1000, 1e9, 0.0, "")
        self.blind = blind

    def step(self, action: np.ndarray) -> tuple[dict[str, Any] | None, float, bool, bool, dict[str, Any]]:
        self.actions.append(np.array(action))
        success = len(self.actions) == 3
        info = self._info("success" if success else "ongoing")
        return self._lists([self._frame() for _ in range(MOTION)]), 0.0, success, False, info

    def _lists(self, frames: list[dict[str, Any]]) -> dict[str, Any]:
        lists = super()._lists(frames)
        if not self.blind:
            rng = np.random.default_rng(len(self.frames))
            for camera in ("front", "wrist"):
                depths = rng.integers(400, 900, (len(frames), SIZE, SIZE, 1)).astype(np.int16)
                lists[f"{camera}_depth_list"] = list(depths)
                lists[f"{camera}_camera_extrinsic_list"] = [DOWN] * len(frames)
        return lists


def make_motion_env(task: str, split: str, episode: int, max_steps: int, **options: Any) -> MotionEnv:
    return MotionEnv(task, episode, **options)


@pytest.fixture(scope="module")
def policy() -> SAM2ActPolicy:
    match = build_policy("sam2act_plus")
    assert isinstance(match, SAM2ActPolicy)
    return match


def test_every_waypoint_is_requested_once_and_counts_its_frames(policy: SAM2ActPolicy) -> None:
    jobs = [Job("VideoUnmask", "test", 0), Job("PickXtimes", "test", 1)]
    envs = InlineEnvs(2, base=make_motion_env, robot=policy.embodiment, max_steps=1000)
    records = roll(policy, jobs, envs)
    assert [record.outcome for record in records] == ["success", "success"]
    for record in records:
        assert record.steps == 3 * MOTION
        assert record.extra["chunks"] == 3
    for env in envs.made.values():
        assert [action.shape for action in env.actions] == [(7,)] * 3


def test_the_last_frame_of_a_motion_is_the_keyframe(policy: SAM2ActPolicy) -> None:
    env = ChunkEnv(lambda: MotionEnv("PickXtimes", 0), robot=policy.embodiment)
    env.reset()
    frames, *_ = env.step({"actions": np.zeros((1, 7), np.float32)})
    episode = policy.start_episode("pick")
    names = [*policy.embodiment.camera_names, *policy.embodiment.readings]
    views = {name: np.stack(frames[name]) for name in names}
    episode.observe(views, frames["state"])
    cloud = policy.require_processor().cloud(policy.require_processor().shots(views, MOTION - 1))
    assert torch.equal(episode.scene_inputs().points, cloud[0])
    assert torch.equal(episode.scene_inputs().colours, cloud[1])


def test_an_environment_without_depth_is_refused_by_name(policy: SAM2ActPolicy) -> None:
    env = ChunkEnv(lambda: MotionEnv("PickXtimes", 0, blind=True), robot=policy.embodiment)
    with pytest.raises(UserError, match="The policy reads 'front_depth', which this environment does not deliver"):
        env.reset()
