"""Poses of the tool and planned motions: converted, trained on, evaluated and served."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from helpers.h5_files import pose_at, robomme_robot, write_file
from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from helpers.serving_fakes import Served, challenge
from mme_vla import MMEPolicy, UserError
from mme_vla.cli.train import train
from mme_vla.config.composition import compose
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import EpisodeRef, find_files, list_episodes, open_episode
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.data.waypoints import find_motions
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.rollout.environment import ChunkCommand, EpisodeFactory
from mme_vla.processing.processor import Processor
from mme_vla.processing.tokenizer import Tokenizer
from mme_vla.serving.server import PolicyServer
from mme_vla.serving.settings import ServeSettings
from mme_vla.training.settings import TrainRun


def test_poses_are_converted_and_read_as_actions(folder: Path) -> None:
    source = EpisodeSource(folder, robot=robomme_robot("robomme_ee_pose"))
    assert np.array_equal(
        source.actions(0), np.stack([pose_at(t) for t in range(24)]).astype(np.float32)
    )
    assert source.states(0).shape == (24, 8) and list(source.decisions(0)) == list(range(8, 24))
    chunk, recorded = source.action_chunk(0, 20, 6, offset=1)
    assert (
        np.array_equal(chunk[:, 0], np.float32([2.1, 2.2, 2.3, 2.3, 2.3, 2.3]))
        and recorded.sum() == 3
    )


def test_a_motion_is_decided_on_one_frame_before_it_begins() -> None:
    rows = np.repeat(np.array([[np.nan], [1.0], [2.0], [1.0]]), [3, 4, 1, 2], axis=0)
    motions = find_motions(rows, first=50)
    assert motions.decisions.tolist() == [50, 56, 57] and motions.targets.ravel().tolist() == [
        1,
        2,
        1,
    ]
    chunk, recorded = motions.chunk(56, 4)
    assert chunk.ravel().tolist() == [2, 1, 1, 1] and recorded.tolist() == [
        True,
        True,
        False,
        False,
    ]
    assert motions.before(57, 5).ravel().tolist() == [1, 2] and motions.before(
        57, 1
    ).ravel().tolist() == [2]
    assert motions.before(50, 5).shape == (0, 1)


def test_training_samples_of_waypoints_are_the_decisions(folder: Path) -> None:
    panda = robomme_robot("robomme_waypoint")
    source = EpisodeSource(folder, robot=panda)
    # Episode 0 notes its first waypoint at frame 11 of an execution that begins at 8, then every
    # fourth frame another.
    assert source.decisions(0).tolist() == [8, 11, 15, 19]
    stats = compute_norm_stats([source], horizon=panda.action.horizon, robot=panda)
    processor = Processor(28, Tokenizer.load("sample"), stats=stats, embodiment=panda)
    data = TrainingDataset([source], processor, action_offset=1)
    assert len(data) == 4 + len(source.decisions(1))
    assert [data.locate(i) for i in (0, 3, 4)] == [(0, 0, 8), (0, 0, 19), (0, 1, 0)]
    item = data[1]
    back = processor.absolute_actions(item["actions"], item["state"])
    expected = np.stack([pose_at(100 + number) for number in (3, 4, 5, 5)])
    assert torch.allclose(back, torch.as_tensor(expected, dtype=torch.float32), atol=1e-3)


@pytest.mark.parametrize(
    ("model", "name"),
    [("framesamp_modul", "robomme_waypoint"), ("simplesg", "robomme_choice")],
)
def test_a_policy_trains_and_keeps_its_robot(
    folder: Path, tmp_path: Path, model: str, name: str
) -> None:
    words = [
        f"model={model}",
        f"embodiment={name}",
        f"data.sources=[{folder}]",
        "data.val_episodes=[1]",
        f"data.cache.root={tmp_path / 'caches'}",
        "backbone.depth=1",
        "backbone.vision.depth=1",
        "backbone.vision.image_size=16",
        "backbone.vision.patch_size=1",
        "logger=none",
        "train.steps=2",
        "train.batch_size=2",
        "train.workers=0",
        "train.device=cpu",
        "train.val_samples=2",
        "train.open_loop_chunks=1",
        *(["memory.budget=64"] if "framesamp" in model else []),
    ]
    cfg = compose("train", words)
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    policy = MMEPolicy.from_pretrained(
        train(TrainRun.from_config(config), tmp_path / "run", begun=time.perf_counter())
    )
    stats = policy.require_processor().require_stats()
    assert policy.embodiment == robomme_robot(name) and len(stats.state) == 8
    if name == "robomme_choice":
        assert stats.actions.q99[:8].tolist() == [1] * 8
    else:
        assert len(stats.actions) == 7


class MotionEnvs(InlineEnvs):
    """Environments in which an action is a motion of three frames."""

    def start(self, worker: int, job: Job, **how: Any) -> None:
        super().start(worker, job, **how)
        env = self.made[job]
        joints = env.step

        def motion(action: np.ndarray) -> Any:
            steps = [joints(np.append(action, 0.0)) for _ in range(3)]
            observation = {key: [x for step in steps for x in step[0][key]] for key in steps[0][0]}
            return observation, *steps[-1][1:]

        env.step = motion  # type: ignore[method-assign]


def test_a_rollout_of_motions_remembers_every_frame_and_asks_after_each_motion() -> None:
    policy = quick_policy(
        "framesamp_modul", patch_size=8, embodiment="robomme_waypoint", memory={"budget": 64}
    )
    envs = MotionEnvs(robot=policy.embodiment)
    job = Job("VideoUnmask", "test", 1)
    (record,) = roll(policy, [job], envs, max_steps=9)
    assert (
        record.outcome == "timeout" and record.steps % 3 == 0 and record.action_space == "waypoint"
    )
    assert record.chunks == record.steps // 3, (
        "one motion of a chunk is executed, then the policy is asked"
    )
    assert {action[6] for action in envs.made[job].actions} <= {-1.0, 1.0}, (
        "the gripper is opened or closed, no less"
    )
    (result,) = roll(policy, [job], MotionEnvs(robot=policy.embodiment), max_steps=9, draw="all")
    assert result.actions_sha256 == record.actions_sha256


def test_a_pose_out_of_reach_is_the_policys_failure() -> None:
    class OutOfReach(InlineEnvs):
        def start(self, worker: int, job: Job, **how: Any) -> None:
            super().start(worker, job, **how)
            refused = {"status": "error", "error_message": "IK failed"}
            self.made[job].step = lambda action: ({}, 0.0, True, False, refused)  # type: ignore[method-assign]

    policy = quick_policy("pi05", embodiment="robomme_ee_pose")
    (record,) = roll(
        policy, [Job("PickXtimes", "test", 0)], OutOfReach(robot=policy.embodiment), retries=1
    )
    assert (record.outcome, record.steps, record.refused) == ("fail", 0, "IK failed")


def test_a_policy_of_motions_is_served_a_motion_at_a_time() -> None:
    policy = quick_policy("pi05", embodiment="robomme_waypoint")
    frames, states = [np.zeros((32, 32, 3), np.uint8)] * 2, np.zeros((2, 8), np.float32)
    with Served(policy) as served, served.client() as client:
        about = client.metadata
        assert (about["action_space"], about["action_dim"], about["horizon"], about["execute"]) == (
            "waypoint",
            7,
            4,
            1,
        )
        request = challenge(frames, frames, states, True)
        reply = client.infer({**request, "action_space": "waypoint"})["actions"]
        assert reply.shape == (1, 7) and abs(reply[0, 6]) == 1
        with pytest.raises(UserError, match="returns waypoint only"):
            client.infer({**request, "action_space": "joint_angle"})
    with pytest.raises(UserError, match="returns waypoint, 7 numbers"):
        PolicyServer(policy, ServeSettings(action_space="joint_angle"))
    reading = quick_policy("pi05_past_actions", embodiment="robomme_waypoint")
    with pytest.raises(UserError, match="which motions were executed"):
        PolicyServer(reading, ServeSettings())


@pytest.mark.parametrize(
    ("name", "task"),
    [
        ("robomme_ee_pose", "PickXtimes"),
        ("robomme_waypoint", "PickXtimes"),
        ("robomme_choice", "PatternLock"),
    ],
)
def test_recorded_actions_of_a_real_episode_succeed_in_the_environment(
    h5_folder: Path, name: str, task: str
) -> None:
    pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")
    panda, chooses = robomme_robot(name), name == "robomme_choice"
    with open_episode(EpisodeRef(h5_folder / f"record_dataset_{task}.h5", 8, task)) as episode:
        rows = episode.choice_actions() if chooses else episode.pose_actions(panda.action.key[0])
        rows, recorded_options = rows[episode.exec_start :], episode.options
    actions = rows
    if chooses:
        actions = find_motions(rows, 0, panda.action.choice).targets
    elif panda.action.frames != 1:
        actions = find_motions(rows, 0).targets
    env = EpisodeFactory(panda, render=False)(task, "train", 8)
    _, first = env.reset()
    assert not chooses or first.options == recorded_options
    frames, _, terminated, _, report = env.step(ChunkCommand(actions))
    env.close()
    assert terminated and report.status == "success"
    assert len(frames["state"]) == report.frames >= report.executed
    assert (report.frames == report.executed) == (panda.action.frames == 1)


def test_files_without_poses_or_choices_convert_as_before(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [8])
    write_file(tmp_path / "record_dataset_Beta.h5", [8], choices=True)
    convert(list_episodes(find_files([tmp_path])), tmp_path / "out", ConvertOptions(images="png"))
    source = EpisodeSource(tmp_path / "out")
    assert len(source) == 2 and "options" not in source.records[0]
    for name, feature in (
        ("robomme_waypoint", "waypoint_actions"),
        ("robomme_choice", "choice_actions"),
    ):
        with pytest.raises(UserError, match=f"lacks the feature {feature}"):
            EpisodeSource(tmp_path / "out", robot=robomme_robot(name))
