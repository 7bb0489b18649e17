"""Keyframes with depth beside a dataset, the chains they form, and the clouds they become."""

import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from helpers.h5_files import pose_at, write_file
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes, open_episode
from mme_vla.errors import UserError
from mme_vla.extras.methods.sam2act import keyframes
from mme_vla.extras.methods.sam2act.geometry import Cube
from mme_vla.extras.methods.sam2act.keyframes import (
    EpisodeKeyframes,
    KeyframeDataset,
    KeyframeFile,
    KeyframeSample,
    Link,
    motions_of,
)
from mme_vla.extras.methods.sam2act.processor import Shot, cloud_images, cloud_of

LENGTHS, VIDEOS = [32, 14], [12, 0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recorded episodes and the dataset made of them."""
    folder = tmp_path_factory.mktemp("keyframes")
    write_file(folder / "record_dataset_Alpha.h5", LENGTHS, VIDEOS, poses=True, depth=True)
    options = ConvertOptions(images="png", keyframes=True)
    convert(list_episodes(find_files([folder])), folder / "out", options)
    return folder


class Identity:
    """Hands samples on as they are."""

    def item(self, sample: KeyframeSample) -> dict[str, Any]:
        return {"sample": sample}


def test_the_motions_of_video_and_execution_follow_each_other(folder: Path) -> None:
    with open_episode(list_episodes(find_files([folder]))[0]) as episode:
        motions = motions_of(episode)
    assert motions.decisions[0] == 0
    assert VIDEOS[0] in motions.decisions
    assert (np.diff(motions.decisions) > 0).all()
    first_of_execution = motions.targets[motions.decisions.tolist().index(VIDEOS[0])]
    assert np.allclose(first_of_execution, pose_at(100 + (VIDEOS[0] + 3) // 4), atol=1e-6)


def test_every_chain_leads_from_its_entry_to_the_last_motion(folder: Path) -> None:
    stored = EpisodeKeyframes(KeyframeFile.file_of(folder / "out", 0))
    decisions = stored.motions.decisions.tolist()
    assert [chain[0].frame for chain in stored.chains] == list(range(0, LENGTHS[0], 10))
    for chain in stored.chains:
        assert [link.place for link in chain] == list(range(len(chain)))
        assert [link.frame for link in chain[1:]] == decisions[-len(chain) + 1 :][: len(chain) - 1]
        assert chain[-1].motion == len(decisions) - 1
        entry = chain[0]
        assert decisions[entry.motion] <= entry.frame
        assert entry.motion == len(decisions) - 1 or entry.frame < decisions[entry.motion + 1]


def test_what_is_stored_is_what_was_recorded(folder: Path) -> None:
    ref = list_episodes(find_files([folder]))[0]
    stored = EpisodeKeyframes(KeyframeFile.file_of(folder / "out", 0))
    with open_episode(ref) as episode:
        for frame, shots in zip([0, 12], stored.shots([0, 12]), strict=True):
            for shot, camera in zip(shots, ("front", "wrist"), strict=True):
                recorded = Shot(**episode.shot(frame, camera)).shrunk(128)
                assert np.array_equal(shot.colours, recorded.colours)
                assert np.array_equal(shot.depth, recorded.depth)
                assert np.array_equal(shot.intrinsic, recorded.intrinsic)
                assert np.array_equal(shot.extrinsic, recorded.extrinsic)
        assert stored.commanded_open([0, 12]).tolist() == [
            episode.commanded_open(0),
            episode.commanded_open(12),
        ]


def test_recordings_without_depth_are_refused_by_name(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [8], poses=True)
    refs = list_episodes(find_files([tmp_path]))
    with (
        open_episode(refs[0]) as episode,
        pytest.raises(UserError, match=r"front_depth.*record it with depth"),
    ):
        KeyframeFile.write(episode, tmp_path / "kept.npz")


def test_a_conversion_without_keyframes_is_another_plan_and_has_none(
    folder: Path, tmp_path: Path
) -> None:
    refs = list_episodes(find_files([folder]))
    convert(refs, tmp_path / "out", ConvertOptions(images="png"))
    assert not KeyframeFile.file_of(tmp_path / "out", 0).exists()
    with pytest.raises(UserError, match="is not the result of this conversion"):
        convert(refs, tmp_path / "out", ConvertOptions(images="png", keyframes=True))
    with pytest.raises(UserError, match="keyframes=true"):
        EpisodeKeyframes(KeyframeFile.file_of(tmp_path / "out", 0))


def source_of(folder: Path) -> EpisodeSource:
    return EpisodeSource(folder / "out")


def test_transitions_are_one_for_every_keyframe_of_every_chain(folder: Path) -> None:
    source = source_of(folder)
    data = KeyframeDataset([source], Identity(), 1, sampled=False)
    chains = [
        chain
        for e in range(len(LENGTHS))
        for chain in EpisodeKeyframes(KeyframeFile.file_of(source.root, e)).chains
    ]
    assert len(data) == sum(map(len, chains))
    assert data.total_frames == sum(LENGTHS)
    item = data[0]
    assert item["place"] == (0, 0, 0)
    assert item["sample"].goal == "do task 0"
    assert item["sample"].targets.shape == (1, 7)


@pytest.mark.parametrize("damage", ["another episode's", "frames", "decisions", "targets"])
def test_keyframes_of_another_episode_than_the_tables_hold_are_refused(
    folder: Path, tmp_path: Path, damage: str
) -> None:
    shutil.copytree(folder / "out", tmp_path / "out")
    path = KeyframeFile.file_of(tmp_path / "out", 0)
    if damage == "another episode's":
        shutil.copy(KeyframeFile.file_of(tmp_path / "out", 1), path)
    else:
        arrays = dict(np.load(path))
        arrays[damage] = arrays[damage] + (np.nan if damage == "targets" else 1)
        np.savez(path, **arrays)
    with pytest.raises(UserError, match=rf"episode_000000.npz .* of {LENGTHS[0]} frames"):
        KeyframeDataset([source_of(tmp_path)], Identity(), 1)


def test_windows_depend_on_seed_epoch_and_place_alone_and_spare_the_last_one(folder: Path) -> None:
    data, again = (
        KeyframeDataset([source_of(folder)], Identity(), 3, seed=5, sampled=False) for _ in range(2)
    )
    begins: dict[int, set[int]] = {}
    for epoch in range(12):
        data.set_epoch(epoch)
        again.set_epoch(epoch)
        for index in range(len(data)):
            *_, links = data.window(index)
            assert links == again.window(index)[-1]
            assert len(links) == 3
            begins.setdefault(index, set()).add(links[0].place)
    for index, start in begins.items():
        length = len(data._items[index][3])
        assert start == set(range(max(length - 3, 1)))


class ManyTasks:
    """Episodes of tasks with unlike numbers of episodes, chains and keyframes; an episode is its
    chains' lengths.
    """

    def __init__(self, episodes: dict[str, list[list[int]]]) -> None:
        self.tasks = [task for task, of_task in episodes.items() for _ in of_task]
        self.chains = [lengths for of_task in episodes.values() for lengths in of_task]
        self.lengths, self.root = np.full(len(self.tasks), 10), Path("nowhere")

    def __len__(self) -> int:
        return len(self.tasks)

    def task(self, episode: int) -> str:
        return self.tasks[episode]

    def goal(self, episode: int) -> str:
        return f"do {self.tasks[episode]}"


def sampled_shares(
    episodes: dict[str, list[list[int]]], length: int, monkeypatch: pytest.MonkeyPatch
) -> tuple[dict[str, float], dict[tuple[int, int], float]]:
    """How often tasks, and places (episode, links of the chain) are sampled."""
    source: Any = ManyTasks(episodes)

    def keep(path: Path) -> Any:
        number = int(path.stem.split("_")[1])
        chains = [
            [Link(place, place, place) for place in range(count)] for count in source.chains[number]
        ]
        return SimpleNamespace(check=lambda length: None, chains=chains)

    monkeypatch.setattr(keyframes, "EpisodeKeyframes", keep)
    data = KeyframeDataset([source], Identity(), length)
    counts: Counter[str] = Counter()
    places: Counter[tuple[int, int]] = Counter()
    for epoch in range(-(-6000 // len(data))):
        data.set_epoch(epoch)
        for index in range(len(data)):
            _, episode, chains, links = data.window(index)
            counts[source.task(episode)] += 1
            places[episode, links[0].frame if length == 1 else len(chains.chains)] += 1
    total = counts.total()
    return {k: n / total for k, n in counts.items()}, {k: n / total for k, n in places.items()}


def test_the_first_stage_draws_a_task_and_then_one_of_its_transitions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shares, places = sampled_shares({"few": [[2]], "many": [[4, 4, 4], [8]]}, 1, monkeypatch)
    assert shares == pytest.approx({"few": 0.5, "many": 0.5}, abs=0.03)
    assert places[0, 0] == pytest.approx(0.25, abs=0.03) and places[2, 7] == pytest.approx(
        0.5 / 20, abs=0.01
    )


def test_the_memorys_stage_draws_task_episode_and_chain_again_where_it_is_too_short(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of `half` every second sample is rejected, and then a task is sampled anew: it occurs half as
    often.
    """
    shares, places = sampled_shares(
        {"half": [[5, 1]], "whole": [[5], [5, 5, 5]], "never": [[2]]}, 3, monkeypatch
    )
    assert shares == pytest.approx({"half": 1 / 3, "whole": 2 / 3}, abs=0.03)
    assert places[1, 1] == pytest.approx(1 / 3, abs=0.03) and places[2, 3] == pytest.approx(
        1 / 3, abs=0.03
    )


def test_depth_becomes_a_table_at_its_height(folder: Path) -> None:
    shots = EpisodeKeyframes(KeyframeFile.file_of(folder / "out", 0)).shots([0])[0]
    points, colours = cloud_of(shots, 128)
    assert points.shape == colours.shape == (2 * 128**2, 3)
    assert np.allclose(points[:, 2], 0.2, atol=1e-6)
    # 0.8 m away an image of 90° / 2 of slope ½ is 0.4 m wide.
    assert np.allclose([points[:, 0].min(), points[:, 0].max()], [-0.2, 0.2], atol=0.01)


def test_a_cloud_outside_of_the_cube_shows_nothing() -> None:
    cube = Cube.of((-1, -1, -1, 1, 1, 1))
    outside = torch.full((1, 5, 3), 2.0)
    images = cloud_images(outside, torch.ones(1, 5, 3), cube, 14)
    assert not images[0, :, :6].any()
    assert (images[0, :, 6] == -1).all()
