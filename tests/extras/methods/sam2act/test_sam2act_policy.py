"""SAM2Act+ as a policy: what it learns, and what an episode remembers."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.depth_env import readings
from helpers.h5_files import write_file
from helpers.scripted_env import SIZE
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.data.lerobot_files import SIDE_FILE
from mme_vla.errors import UserError
from mme_vla.extras.methods.sam2act.keyframes import KeyframeDataset, KeyframeFile
from mme_vla.extras.methods.sam2act.policy import SAM2ActPolicy
from mme_vla.extras.methods.sam2act.processor import KeyframeBatch
from mme_vla.policy.build import build_policy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.training.data import prepare_data
from mme_vla.training.settings import DataSettings


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
    convert(
        list_episodes(find_files([folder])),
        folder / "out",
        ConvertOptions(images="png", keyframes=True),
    )
    return folder / "out"


def batch_of(policy: SAM2ActPolicy, data: Path, count: int = 2) -> KeyframeBatch:
    samples = KeyframeDataset([EpisodeSource(data)], policy.require_processor(), policy.keyframes)
    return policy.require_processor().collate([samples[i] for i in range(count)])


def views(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """What an environment delivers of `count` frames."""
    rng = np.random.default_rng(seed)
    images = {
        name: rng.integers(0, 255, (count, SIZE, SIZE, 3), np.uint8) for name in ("front", "wrist")
    }
    return images | readings(count, seed)


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
    for _ in range(3):
        loss, metrics = policy(batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    assert metrics["loss"].item() == pytest.approx(
        sum(v.item() for k, v in metrics.items() if k != "loss"), rel=1e-5
    )
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


def test_what_is_remembered_reaches_the_waypoints_scores(policy: SAM2ActPolicy) -> None:
    frames = views(2)
    fresh, experienced = (
        policy.start_episode("pick the cube"),
        policy.start_episode("pick the cube"),
    )
    experienced.observe(views(4, seed=5), states(4), True)
    for episode in (fresh, experienced):
        episode.observe(frames, states(2))
    observations = [policy.observation([episode])[0] for episode in (fresh, experienced)]
    after = [
        policy.watch(s, e.remembered).maps[-1]
        for s, e in zip(observations, (fresh, experienced), strict=True)
    ]
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


def test_robots_without_depth_or_with_other_actions_are_refused() -> None:
    with pytest.raises(UserError, match="needs depth of every camera"):
        built(embodiment="robomme_waypoint")
    with pytest.raises(UserError, match="one planned motion of 7 numbers"):
        built(embodiment={"action": {"horizon": 2}})


def test_selected_keyframes_count_as_data_of_a_run(
    policy: SAM2ActPolicy, data: Path, tmp_path: Path
) -> None:
    copied = tmp_path / "data"
    shutil.copytree(data, copied)

    def side_files() -> dict[str, str]:
        settings = DataSettings([str(copied)])
        return prepare_data(policy, settings, 0, say=lambda line: None).side_files[0]

    before = side_files()
    assert before.keys() == {"keyframes", SIDE_FILE} and side_files() == before
    path = KeyframeFile.file_of(copied, 0)
    with np.load(path) as arrays:
        content = dict(arrays)
    content["targets"][0, 0] += 1
    np.savez_compressed(path, **content)
    after = side_files()
    assert after["keyframes"] != before["keyframes"] and after[SIDE_FILE] == before[SIDE_FILE]
