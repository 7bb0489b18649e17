"""Reading LeRobot v3.0 datasets: images or videos, offline, and clear words where they
do not fit.
"""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers.h5_files import write_file
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.data.sources import open_sources
from mme_vla.data.video import VideoReader
from mme_vla.errors import UserError


@pytest.fixture(scope="module")
def sample() -> EpisodeSource:
    return EpisodeSource("sample")


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    shutil.copytree(SAMPLE, tmp_path / "copy")
    return tmp_path / "copy"


def edit_info(root: Path, change: Callable[[dict], object]) -> None:
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def without(*names: str) -> Callable[[dict], object]:
    return lambda info: [info["features"].pop(name) for name in names]


def test_values_and_images_equal_lerobots_reader(sample: EpisodeSource) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    reference = LeRobotDataset("local/sample", root=SAMPLE, video_backend="pyav", return_uint8=True)
    for episode, step in ((0, 0), (0, 100), (1, 147), (3, 17)):
        item = reference[int(sample.lengths[:episode].sum()) + step]
        assert np.array_equal(item["state"].numpy(), sample.states(episode, step, step + 1)[0])
        assert np.array_equal(item["actions"].numpy(), sample.actions(episode, step, step + 1)[0])
        assert item["task"] == sample.goal(episode)
        assert item["grounded_subgoal"] == sample.subgoals(episode, step)["grounded_subgoal"]
        for camera, column in (("front", "image"), ("wrist", "wrist_image")):
            frame = sample.frames(episode, [step], camera)[0]
            assert np.array_equal(item[column].permute(1, 2, 0).numpy(), frame)


def test_single_images_equal_the_sequence_in_any_order(sample: EpisodeSource) -> None:
    sequence = sample.frames(0, np.arange(173))
    order = np.random.default_rng(0).permutation(173)[:20]
    assert np.array_equal(sample.frames(0, order), sequence[order])
    assert np.array_equal(np.concatenate([sample.frames(0, [i]) for i in order]), sequence[order])


def test_action_chunks_repeat_the_last_action(sample: EpisodeSource) -> None:
    actions, recorded = sample.action_chunk(0, 170, 6)
    assert np.array_equal(actions[:3], sample.actions(0, 170)) and (actions[3:] == actions[2]).all()
    assert recorded.tolist() == [True] * 3 + [False] * 3
    beyond, recorded = sample.action_chunk(0, 173, 4)
    assert (beyond == actions[2]).all() and not recorded.any()


def test_open_videos_are_bounded_and_not_shared_with_other_processes(sample: EpisodeSource) -> None:
    import multiprocessing

    source = EpisodeSource("sample")
    source._reader = VideoReader(max_open=1)
    expected = source.frames(0, [3, 90])
    source.frames(0, [5], "wrist")
    assert len(source._reader._open) == 1
    with multiprocessing.get_context("fork").Pool(2) as pool:
        for frames in pool.starmap(source.frames, [(0, [3, 90])] * 4):
            assert np.array_equal(frames, expected)


def test_the_fingerprint_follows_the_content_not_the_place(
    sample: EpisodeSource, copy: Path
) -> None:
    assert EpisodeSource(copy).fingerprint == sample.fingerprint
    video = next(copy.glob("videos/image/**/*.mp4"))
    content = bytearray(video.read_bytes())
    content[len(content) // 2 + 10] ^= 255
    video.write_bytes(content)
    assert EpisodeSource(copy).fingerprint != sample.fingerprint


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            without("wrist_image", "actions"),
            "lacks the features wrist_image, actions; it has image, state",
        ),
        (lambda info: info["features"]["state"].update(shape=[7]), r"state has shape \[7\]"),
        (
            lambda info: info.update(codebase_version="v2.1"),
            "convert_dataset_v21_to_v30 --repo-id=copy",
        ),
    ],
)
def test_a_dataset_that_does_not_fit_is_refused(
    copy: Path, change: Callable[[dict], object], words: str
) -> None:
    edit_info(copy, change)
    with pytest.raises(UserError, match=words):
        EpisodeSource(copy)


def test_a_dataset_without_demonstration_flag_needs_a_side_file(
    copy: Path, sample: EpisodeSource
) -> None:
    edit_info(copy, without("is_demo", "exec_start_idx"))
    with pytest.raises(UserError, match="neither is_demo nor exec_start_idx"):
        EpisodeSource(copy)
    starts = dict(enumerate(sample.exec_starts.tolist()))
    (copy / "starts.json").write_text(json.dumps(starts))
    assert EpisodeSource(copy, copy / "starts.json").exec_starts.tolist() == [66, 74, 0, 66]
    table = {"episode_index": list(starts), "exec_start_idx": list(starts.values())}
    pq.write_table(pa.table(table), copy / "starts.parquet")
    assert EpisodeSource(copy, copy / "starts.parquet").exec_starts.tolist() == [66, 74, 0, 66]
    (copy / "starts.json").write_text(json.dumps({"0": 66}))
    with pytest.raises(UserError, match=r"covers no episode 1, 2, 3; it must name all 4"):
        EpisodeSource(copy, copy / "starts.json")
    (copy / "starts.json").write_text(json.dumps({**starts, 1: 148}))
    with pytest.raises(UserError, match="episode 1 starts execution at frame 148"):
        EpisodeSource(copy, copy / "starts.json")


def test_exec_start_idx_alone_is_enough_and_reported(copy: Path, caplog) -> None:
    edit_info(copy, without("is_demo"))
    assert EpisodeSource(copy).exec_starts.tolist() == [66, 74, 0, 66]
    assert "has no is_demo" in caplog.text


def test_no_or_half_a_dataset_is_refused_before_the_hub_is_queried(
    copy: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=r"No LeRobot dataset at .*hf download"):
        EpisodeSource(tmp_path / "nothing")
    shutil.rmtree(copy / "meta" / "episodes")
    with pytest.raises(UserError, match="incomplete"):
        EpisodeSource(copy)


def test_missing_rows_are_noticed(copy: Path) -> None:
    path = next(copy.glob("data/*/*.parquet"))
    table = pq.read_table(path)
    pq.write_table(table.slice(0, 800), path)
    with pytest.raises(UserError, match="800 rows where meta/episodes describes 916"):
        EpisodeSource(copy)


def test_damaged_and_missing_videos_are_named(copy: Path) -> None:
    video = next(copy.glob("videos/image/**/*.mp4"))
    content = video.read_bytes()
    video.write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match=r"file-000.mp4 holds no image at 42.650 s"):
        EpisodeSource(copy).frames(3, [200])
    video.write_bytes(b"no video at all")
    with pytest.raises(UserError, match=r"file-000.mp4 is damaged: it cannot be read as a video"):
        EpisodeSource(copy).frames(0, [0])
    video.unlink()
    with pytest.raises(UserError, match=rf"^{re.escape(str(video))} is missing"):
        EpisodeSource(copy).frames(0, [0])


def test_frames_outside_an_episode_are_refused(sample: EpisodeSource) -> None:
    with pytest.raises(UserError, match="of 173"):
        sample.frames(0, [173])
    with pytest.raises(UserError, match="of 173"):
        sample.states(0, 170, 174)


def test_several_sources_open_under_their_names(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [6])
    convert(list_episodes(find_files([tmp_path])), tmp_path / "alpha", ConvertOptions(images="png"))
    sources = open_sources(["sample", {"root": str(tmp_path / "alpha"), "name": "mine"}])
    assert [source.name for source in sources] == ["sample", "mine"]
    with pytest.raises(UserError, match="same name"):
        open_sources(["sample", "sample"])
    with pytest.raises(UserError, match="Did you mean 'exec_starts'"):
        open_sources([{"root": "sample", "exec_start": "x.json"}])
    with pytest.raises(UserError, match="empty"):
        open_sources([])
