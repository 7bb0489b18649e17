"""HDF5 → LeRobot, resumable."""

import json
from pathlib import Path

import numpy as np
import pytest

import mme_vla.data.convert as convert_module
from helpers.h5_files import Recorded, write_file
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import EpisodeRef, find_files, list_episodes
from mme_vla.errors import UserError

PNG = ConvertOptions(images="png")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> tuple[list[EpisodeRef], list[Recorded]]:
    folder = tmp_path_factory.mktemp("recorded")
    episodes = write_file(folder / "record_dataset_Alpha.h5", [12, 9], videos=[5, 0])
    episodes += write_file(folder / "record_dataset_Beta.h5", [7])
    return list_episodes(find_files([folder])), episodes


@pytest.fixture(scope="module")
def video_dataset(recorded, tmp_path_factory) -> tuple[Path, list[Recorded]]:
    """The episodes as a dataset with videos."""
    refs, episodes = recorded
    folder = tmp_path_factory.mktemp("filmed") / "out"
    convert(refs, folder)
    return folder, episodes


def check(source: EpisodeSource, episodes: list[Recorded], tolerance: int) -> None:
    assert source.lengths.tolist() == [12, 9, 7] and source.exec_starts.tolist() == [5, 0, 0]
    assert [source.task(e) for e in range(3)] == ["Alpha", "Alpha", "Beta"]
    assert [source.goal(e) for e in range(3)] == ["do task 0", "do task 1", "do task 0"]
    assert [record["seed"] for record in source.records] == [0, 100, 0]
    for e, expected in enumerate(episodes):
        assert np.array_equal(source.states(e), expected.state)
        assert np.array_equal(source.actions(e), expected.actions.astype(np.float32))
        for view, frames in (("front", expected.front), ("wrist", expected.wrist)):
            decoded = source.frames(e, np.arange(len(frames)), view)
            assert np.abs(decoded.astype(int) - frames).max() <= tolerance
    assert source.subgoals(0, 4)["simple_subgoal_online"] == "pick up 1 online"


def test_png_conversion_is_exact(tmp_path: Path, recorded) -> None:
    refs, episodes = recorded
    assert convert(refs, tmp_path / "out", PNG) == 3
    check(EpisodeSource(tmp_path / "out"), episodes, tolerance=0)
    assert EpisodeSource(tmp_path / "out").verify() > 5
    stats = json.loads((tmp_path / "out" / "meta" / "stats.json").read_text())
    assert list(stats) == sorted(stats), "an order of a set would differ between processes"
    assert not (tmp_path / "out.partial").exists()


def test_columns_may_be_spelt_as_lerobots_policies_ask_for(tmp_path: Path, recorded) -> None:
    refs, episodes = recorded
    convert(refs, tmp_path / "out", ConvertOptions(images="png", names="lerobot"))
    source = EpisodeSource(tmp_path / "out")
    check(source, episodes, tolerance=0)
    assert dict(source.columns) == {
        "front": "observation.images.image",
        "wrist": "observation.images.wrist_image",
    }
    features = json.loads((tmp_path / "out/meta/info.json").read_text())["features"]
    assert {"observation.state", "action", "is_demo"} <= set(features)
    assert not {"image", "wrist_image", "state", "actions"} & set(features)
    assert convert(refs, tmp_path / "out", ConvertOptions(images="png", names="lerobot")) == 0
    with pytest.raises(UserError, match="is not the result of this conversion"):
        convert(refs, tmp_path / "out", PNG)
    with pytest.raises(UserError, match=r"names='lerobbot'.*lerobot"):
        ConvertOptions(names="lerobbot")


def test_video_conversion_only_rounds_colours_and_keeps_still_pixels_still(video_dataset) -> None:
    folder, episodes = video_dataset
    source = EpisodeSource(folder)
    assert source.video_cameras == ("front", "wrist") and source.fps == 20
    check(source, episodes, tolerance=3)
    frames = source.frames(0, np.arange(12))
    assert np.array_equal(frames[:, :, 8:], np.repeat(frames[:1, :, 8:], 12, axis=0))


def test_an_interrupted_conversion_continues_with_the_missing_episodes(
    tmp_path: Path, recorded, monkeypatch
) -> None:
    refs, episodes = recorded
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    add_frame, calls = LeRobotDataset.add_frame, []

    def killed(self, frame) -> None:
        calls.append(1)
        if len(calls) == 15:  # in the middle of the second episode
            raise KeyboardInterrupt
        add_frame(self, frame)

    with monkeypatch.context() as patch:
        patch.setattr(LeRobotDataset, "add_frame", killed)
        with pytest.raises(KeyboardInterrupt):
            convert(refs, tmp_path / "out", PNG)
    assert not (tmp_path / "out").exists()
    assert len(list((tmp_path / "out.partial" / "episodes").iterdir())) == 1
    converted = []
    write = convert_module._write_part
    monkeypatch.setattr(
        convert_module,
        "_write_part",
        lambda ref, part, options: (converted.append(part.name), write(ref, part, options)),
    )
    assert convert(refs, tmp_path / "out", PNG) == 2
    assert converted == ["000001-Alpha-episode_1", "000002-Beta-episode_0"]
    check(EpisodeSource(tmp_path / "out"), episodes, tolerance=0)


def test_a_kill_during_the_merge_loses_nothing(tmp_path: Path, recorded, monkeypatch) -> None:
    refs, episodes = recorded
    with monkeypatch.context() as patch:
        merge = convert_module._merge

        def half(parts, merged, plan) -> None:
            merge(parts, merged, plan)
            raise KeyboardInterrupt

        patch.setattr(convert_module, "_merge", half)
        with pytest.raises(KeyboardInterrupt):
            convert(refs, tmp_path / "out", PNG)
    assert convert(refs, tmp_path / "out", PNG) == 0
    check(EpisodeSource(tmp_path / "out"), episodes, tolerance=0)


def test_a_finished_conversion_is_recognised_and_nothing_foreign_is_overwritten(
    tmp_path: Path, recorded
) -> None:
    refs, _ = recorded
    convert(refs[:1], tmp_path / "out", PNG)
    assert convert(refs[:1], tmp_path / "out", PNG) == 0
    with pytest.raises(UserError, match="exists and is not the result of this conversion"):
        convert(refs, tmp_path / "out", PNG)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(UserError, match="Choose another output"):
        convert(refs, tmp_path / "mine", PNG)
    assert (tmp_path / "mine" / "thesis.txt").exists()
    partial = tmp_path / "new.partial"
    partial.mkdir()
    (partial / "plan.json").write_text(json.dumps({"options": {}, "episodes": []}))
    with pytest.raises(UserError, match="belongs to another conversion"):
        convert(refs, tmp_path / "new", PNG)


def test_an_episode_that_no_file_has_is_named(recorded, tmp_path: Path) -> None:
    from omegaconf import OmegaConf

    from mme_vla.cli.convert import main

    refs, _ = recorded
    words = {"input": str(refs[0].file.parent), "output": str(tmp_path / "out"), "episodes": [1, 7]}
    with pytest.raises(UserError, match="episodes names 7, which none of the files has; they have"):
        main(OmegaConf.create(words))
