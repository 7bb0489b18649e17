"""SAM2Act+ as a policy: what it learns, what an episode remembers, training by command, a rollout of waypoints."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from helpers.h5_files import write_file
from mme_vla.cli.train import train
from mme_vla.config.composition import compose
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.data.keyframes import KeyframeDataset
from mme_vla.errors import UserError
from mme_vla.methods.sam2act.policy import SAM2ActPolicy
from mme_vla.methods.sam2act.processor import KeyframeBatch
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_policy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.policy.tensor_files import load_tensors
from mme_vla.training.logging import read_metrics

DOWN = np.array([[0, -1, 0, 0.0], [-1, 0, 0, 0.0], [0, 0, -1, 1.0]], np.float32)


def built(**overrides: Any) -> SAM2ActPolicy:
    policy = build_policy("sam2act_plus", **overrides)
    assert isinstance(policy, SAM2ActPolicy)
    return policy


@pytest.fixture(scope="module")
def policy() -> SAM2ActPolicy:
    return built()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of one small episode with keyframes."""
    folder = tmp_path_factory.mktemp("sam2act")
    write_file(folder / "record_dataset_Alpha.h5", [40], [12], poses=True, depth=True)
    convert(list_episodes(find_files([folder])), folder / "out", ConvertOptions(images="png", keyframes=True))
    return folder / "out"


def batch_of(policy: SAM2ActPolicy, data: Path, count: int = 2) -> KeyframeBatch:
    samples = KeyframeDataset([EpisodeSource(data)], policy.require_processor(), policy.keyframes)
    return policy.require_processor().collate([samples[i] for i in range(count)])


def views(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """What an environment delivers of `count` frames."""
    rng, observations = np.random.default_rng(seed), {}
    for camera in ("front", "wrist"):
        observations[camera] = rng.integers(0, 255, (count, 64, 64, 3), np.uint8)
        observations[f"{camera}_depth"] = rng.integers(400, 1000, (count, 64, 64, 1)).astype(np.int16)
        observations[f"{camera}_camera_extrinsic"] = np.tile(DOWN, (count, 1, 1))
    return observations


def states(count: int) -> np.ndarray:
    return np.full((count, 8), 0.04, np.float32)


@pytest.mark.parametrize("stage", ["first", "memory"])
def test_each_stage_learns_what_it_trains_and_leaves_the_remainder(data: Path, stage: str) -> None:
    policy = built(policy={"stage": stage})
    apply_finetuning(policy, "full")
    before = {name: value.clone() for name, value in policy.named_parameters()}
    trained = [value for value in policy.parameters() if value.requires_grad]
    batch, optimizer = batch_of(policy, data), torch.optim.Adam(trained, 3e-3)
    losses = []
    policy.eval()  # neither dropout nor augmentation: the same samples again and again
    for _ in range(6):
        loss, metrics = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    assert metrics["loss"].item() == pytest.approx(sum(v.item() for k, v in metrics.items() if k != "loss"), rel=1e-5)
    for name, value in policy.named_parameters():
        assert value.requires_grad or torch.equal(value, before[name]), name
    assert len(metrics) == {"first": 7, "memory": 2}[stage]


def test_augmentation_moves_clouds_and_is_reported_by_its_draws_alone(data: Path) -> None:
    policy = built()
    batch = batch_of(policy, data)
    torch.manual_seed(0)
    policy.train()
    for module in policy.modules():  # dropout off
        if module is not policy:
            module.eval()
    one, other = (policy.training_noise(2, torch.Generator().manual_seed(seed)) for seed in (1, 2))
    with torch.no_grad():
        first, again, second = (policy(batch, draws)[0] for draws in (one, one, other))
        baseline = policy.eval()(batch, one)[0]
    assert first == again
    assert len({first.item(), second.item(), baseline.item()}) == 3


def test_an_episode_remembers_keyframes_once_they_lie_behind(policy: SAM2ActPolicy) -> None:
    episode = policy.start_episode("pick the cube")
    with pytest.raises(UserError, match=r"no frame yet|no execution frame"):
        policy.act(episode)
    episode.observe(views(7), states(7), np.arange(7) < 6)
    of_video = min(6, policy.require_processor().video_frames, policy.backbone.sizes.remembered)
    assert len(episode.remembered) == of_video
    waypoint = policy.act(episode)
    assert waypoint.shape == (1, 7)
    assert waypoint[0, 6] in (-1, 1)
    assert np.array_equal(policy.act(episode), waypoint)  # asked again: nothing was added
    n_entries = episode.remembered
    episode.observe(views(3, seed=1), states(3))
    assert episode.waypoints == 1
    assert episode.remembered.maps[-1] is not n_entries.maps[-1]


def test_pieces_of_frames_are_as_good_as_all_of_them(policy: SAM2ActPolicy) -> None:
    straight, pieces = policy.start_episode("pick the cube"), policy.start_episode("pick the cube")
    frames, demo = views(9), np.arange(9) < 7
    straight.observe(frames, states(9), demo)
    for part in (slice(0, 4), slice(4, 7), slice(7, 9)):
        pieces.observe({name: value[part] for name, value in frames.items()}, states(9)[part], demo[part])
    assert np.array_equal(policy.act(straight), policy.act(pieces))


def test_what_is_remembered_reaches_the_waypoints_scores(policy: SAM2ActPolicy) -> None:
    frames = views(2)
    fresh, experienced = policy.start_episode("pick the cube"), policy.start_episode("pick the cube")
    experienced.observe(views(4, seed=5), states(4), True)
    for episode in (fresh, experienced):
        episode.observe(frames, states(2))
    observations = [policy.observation([episode])[0] for episode in (fresh, experienced)]
    after = [policy.watch(s, e.remembered).maps[-1] for s, e in zip(observations, (fresh, experienced), strict=True)]
    assert not torch.equal(*after)


def test_episodes_in_one_batch_act_as_alone(policy: SAM2ActPolicy) -> None:
    def begun(seed: int) -> Any:
        episode = policy.start_episode("pick the cube", seed)
        episode.observe(views(2 + seed, seed), states(2 + seed), np.arange(2 + seed) < seed)
        return episode

    together = policy.act([begun(0), begun(2)])
    assert np.array_equal(together, np.stack([policy.act(begun(0)), policy.act(begun(2))]))


@pytest.mark.parametrize("lacking", ["front_depth", "wrist_camera_extrinsic"])
def test_missing_depth_or_poses_are_named(policy: SAM2ActPolicy, lacking: str) -> None:
    frames = views(1)
    del frames[lacking]
    with pytest.raises(UserError, match=lacking):
        policy.start_episode("pick").observe(frames, states(1))


def test_misshapen_depth_is_named(policy: SAM2ActPolicy) -> None:
    frames = views(1)
    frames["front_depth"] = frames["front_depth"][:, :10]
    with pytest.raises(UserError, match=r"front_depth must be \[1, 64, 64, 1\]"):
        policy.start_episode("pick").observe(frames, states(1))


def test_a_saved_policy_acts_as_before(policy: SAM2ActPolicy, tmp_path: Path) -> None:
    policy.save_pretrained(tmp_path)
    loaded = Policy.from_pretrained(tmp_path)
    assert isinstance(loaded, SAM2ActPolicy)
    answers = []
    for each in (policy, loaded):
        episode = each.start_episode("pick the cube")
        episode.observe(views(2), states(2))
        answers.append(each.act(episode))
    assert np.array_equal(*answers)


def test_robots_without_depth_or_with_other_actions_are_refused() -> None:
    with pytest.raises(UserError, match="needs depth of every camera"):
        built(embodiment="robomme_waypoint")
    with pytest.raises(UserError, match="one planned motion of 7 numbers"):
        built(embodiment={"action": {"horizon": 2}})


def test_it_counts_on_meta_without_anything_to_draw() -> None:
    policy = build_policy("sam2act_plus", device="meta")
    batch = policy.full_batch("meta")
    assert policy(batch)[0].is_meta
    assert policy.sample_actions(batch).shape == (1, 1, 7)


def run(data: Path, folder: Path, *words: str, resume: str = "null") -> Path:
    """Train as the command does; the last checkpoint."""
    small = ["model=sam2act_plus", f"data.sources=[{data}]", "data.val_episodes=[]", "logger=none", "train.workers=0",
             "train.device=cpu", "train.batch_size=2", "train.warmup=1", "train.log_every=1",
             f"resume={resume}"]  # fmt: skip
    cfg = compose("train", [*small, *words])
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    return train(cfg, config, folder, begun=time.perf_counter())


@pytest.mark.parametrize("optimizer", ["adamw", "lamb"])
def test_the_command_trains_it_and_resumes_to_the_last_bit(data: Path, tmp_path: Path, optimizer: str) -> None:
    setting = f"train.optimizer={optimizer}"
    straight = run(data, tmp_path / "whole", setting, "train.steps=2")
    run(data, tmp_path / "parts", setting, "train.steps=1")
    parts = run(data, tmp_path / "new", setting, "train.steps=2", resume=str(tmp_path / "parts"))
    assert parts.parent.parent == tmp_path / "parts"
    assert [line["step"] for line in read_metrics(tmp_path / "whole") if "train/loss" in line] == [1, 2]
    ended = [load_tensors(folder) for folder in (straight, parts)]
    assert all(torch.equal(value, ended[1][name]) for name, value in ended[0].items())
    assert isinstance(Policy.from_pretrained(straight), SAM2ActPolicy)
