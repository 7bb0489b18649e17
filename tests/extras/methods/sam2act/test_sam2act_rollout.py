"""SAM2Act+ in a rollout: depth and poses of cameras come along, one waypoint is one motion of many
frames.
"""

import numpy as np
import pytest
import torch

from helpers.depth_env import MOTION, DepthEnv, make_depth_env
from helpers.rollout_fakes import InlineEnvs, roll
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout.environment import ChunkCommand, ChunkEnv
from mme_vla.extras.methods.sam2act.policy import SAM2ActPolicy
from mme_vla.policy.build import build_policy


@pytest.fixture(scope="module")
def policy() -> SAM2ActPolicy:
    match = build_policy("sam2act_plus")
    assert isinstance(match, SAM2ActPolicy)
    return match


def test_every_waypoint_is_requested_once_and_counts_its_frames(policy: SAM2ActPolicy) -> None:
    jobs = [Job("VideoUnmask", "test", 0), Job("PickXtimes", "test", 1)]
    envs = InlineEnvs(2, base=make_depth_env, robot=policy.embodiment, max_steps=1000)
    records = roll(policy, jobs, envs)
    assert [record.outcome for record in records] == ["success", "success"]
    for record in records:
        assert record.steps == 3 * MOTION
        assert record.chunks == 3
    for env in envs.made.values():
        assert [action.shape for action in env.actions] == [(7,)] * 3


def test_an_episode_ends_after_its_waypoints(policy: SAM2ActPolicy) -> None:
    assert policy.info.max_actions == policy.require_processor().waypoints == 40
    envs = InlineEnvs(base=make_depth_env, robot=policy.embodiment, max_steps=10_000, max_actions=2)
    (record,) = roll(policy, [Job("VideoUnmask", "test", 1)], envs, max_steps=10_000)
    assert (record.outcome, record.chunks, record.steps) == ("timeout", 2, 2 * MOTION)


def test_the_last_frame_of_a_motion_is_the_keyframe(policy: SAM2ActPolicy) -> None:
    env = ChunkEnv(lambda: DepthEnv("PickXtimes", 0), robot=policy.embodiment)
    env.reset()
    frames, *_ = env.step(ChunkCommand(np.zeros((1, 7), np.float32)))
    episode = policy.start_episode("pick")
    names = [*policy.embodiment.camera_names, *policy.embodiment.readings]
    views = {name: np.stack(frames[name]) for name in names}
    episode.observe(views, frames["state"])
    cloud = policy.require_processor().cloud(policy.require_processor().shots(views, MOTION - 1))
    assert torch.equal(episode.scene_inputs().points, cloud[0])
    assert torch.equal(episode.scene_inputs().colours, cloud[1])


def test_an_environment_without_depth_is_refused_by_name(policy: SAM2ActPolicy) -> None:
    env = ChunkEnv(lambda: DepthEnv("PickXtimes", 0, blind=True), robot=policy.embodiment)
    with pytest.raises(
        UserError, match="The policy reads 'front_depth', which this environment does not deliver"
    ):
        env.reset()
