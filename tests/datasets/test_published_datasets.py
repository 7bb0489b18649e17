"""The layouts in which RoboMME is published for LeRobot, made manually: what each has, lacks, and how it is read."""

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.h5_files import write_file
from mme_vla.cli.exec_starts import annotated_episodes, first_frames, main
from mme_vla.data.cache_building import ensure_cache
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.errors import UserError
from mme_vla.testing.small import small_policy

VECTOR = {"dtype": "float32", "shape": (8,), "names": None}
TEXT = {"dtype": "string", "shape": (1,), "names": None}
SUBTASK = {"dtype": "int64", "shape": (1,), "names": None}
LENGTHS, VIDEOS = (9, 7, 9), (4, 0, 2)


@pytest.fixture
def recordings(tmp_path: Path) -> Path:
    folder = tmp_path / "h5"
    folder.mkdir()
    write_file(folder / "record_dataset_Alpha.h5", LENGTHS, videos=VIDEOS, size=64)
    return folder


def publish(root: Path, recordings: Path, image_format: str, more: Mapping[str, Any], order: tuple[int, ...]) -> Path:
    """A dataset of these recordings in the published columns, at 10 frames per second, without demonstration flags."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from mme_vla.data.hdf5 import open_episode

    view = {"dtype": image_format, "shape": (64, 64, 3), "names": ["height", "width", "channel"]}
    features = {"image": view, "wrist_image": view, "state": VECTOR, "actions": VECTOR, "simple_subgoal": TEXT}
    as_video = image_format == "video"
    dataset = LeRobotDataset.create(
        "lerobot/robomme", 10, features | dict(more), root=root, robot_type="panda", use_videos=as_video,
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec="libsvtav1", crf=30, pix_fmt="yuv420p") if as_video else None,
    )  # fmt: skip
    refs = list_episodes(find_files([recordings]))
    for number in order:
        with open_episode(refs[number]) as episode:
            for frame in episode:
                dataset.add_frame({
                    "image": frame.front, "wrist_image": frame.wrist, "state": frame.state,
                    "actions": frame.action.astype(np.float32), "simple_subgoal": frame.subgoals["simple_subgoal"],
                    **{name: np.array([1]) for name in more}, "task": episode.goals[0],
                })  # fmt: skip
        dataset.save_episode()
    dataset.finalize()
    return root


def make_side_file(recordings: Path, dataset: Path, output: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    words = [f"input={recordings}", f"dataset={dataset}", f"output={output}"]
    monkeypatch.setattr("sys.argv", ["exec_starts", *words])
    main()
    return output


def test_videos_in_av1_without_flags_are_read_with_a_side_file(
    tmp_path: Path, recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = publish(tmp_path / "av1", recordings, "video", {}, order=(2, 0, 1))
    with pytest.raises(UserError, match="does not mark its conditioning videos"):
        EpisodeSource(root)
    starts = make_side_file(recordings, root, tmp_path / "starts.json", monkeypatch)
    assert json.loads(starts.read_text()) == {"0": 2, "1": 4, "2": 0}
    source = EpisodeSource(root, exec_starts=starts)
    assert source.exec_starts.tolist() == [2, 4, 0] and source.fps == 10
    assert source.frames(0, [0, 8]).shape == (2, 64, 64, 3)
    assert set(source.lossy) == {"front", "wrist"} and source.lossy["front"].startswith("av1")
    with pytest.raises(SystemExit):
        make_side_file(recordings, root, starts, monkeypatch)


def test_a_memory_that_scores_patches_is_warned_of_lossy_videos(
    tmp_path: Path, recordings: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = publish(tmp_path / "av1", recordings, "video", {}, order=(1,))
    (tmp_path / "starts.json").write_text('{"0": 0}')
    source = EpisodeSource(root, exec_starts=tmp_path / "starts.json")
    for model, warned in (("tokendrop_modul", True), ("framesamp_modul", False)):
        caplog.clear()
        policy = small_policy(model)
        with caplog.at_level(logging.WARNING):
            ensure_cache(source, policy.require_memory(), policy.encode_frames, "x", root=tmp_path / "cache")
        assert ("passes for motion" in caplog.text) == warned


def test_images_inside_the_tables_are_read_as_they_are(tmp_path: Path, recordings: Path) -> None:
    root = publish(tmp_path / "tables", recordings, "image", {}, order=(0, 1, 2))
    (tmp_path / "starts.json").write_text('{"0": 4, "1": 0, "2": 2}')
    source = EpisodeSource(root, exec_starts=tmp_path / "starts.json")
    assert source.video_cameras == () and source.lossy == {}
    convert(list_episodes(find_files([recordings])), tmp_path / "ours", ConvertOptions(images="png"))
    converted = EpisodeSource(tmp_path / "ours")
    np.testing.assert_array_equal(source.frames(2, range(9), "wrist"), converted.frames(2, range(9), "wrist"))


def test_our_demonstrations_mark_videos_too_and_unauthenticated_clients_are_named(
    tmp_path: Path, recordings: Path
) -> None:
    convert(list_episodes(find_files([recordings])), tmp_path / "ours", ConvertOptions(images="png"))
    root = publish(tmp_path / "tables", recordings, "image", {}, order=(1, 2, 0))
    assert first_frames(root, annotated_episodes([tmp_path / "ours"])) == [0, 2, 4]
    others = tmp_path / "others"
    others.mkdir()
    write_file(others / "record_dataset_AnotherSeed.h5", LENGTHS, videos=VIDEOS, size=16)
    with pytest.raises(UserError, match=r"episode 0 .*is not among the 3 episodes given: the nearest is .* rad"):
        first_frames(root, annotated_episodes([others]))
