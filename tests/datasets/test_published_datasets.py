"""The layouts in which RoboMME is published for LeRobot, made manually: what each has, lacks, and
how it is read.
"""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.h5_files import write_file
from mme_vla.cli.exec_starts import annotated_episodes, first_frames, main
from mme_vla.config.composition import compose
from mme_vla.data.cache_building import ensure_cache
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.errors import UserError
from mme_vla.testing.small import small_policy

VECTOR = {"dtype": "float32", "shape": (8,), "names": None}
TEXT = {"dtype": "string", "shape": (1,), "names": None}
LENGTHS, VIDEOS = (9, 7, 9), (4, 0, 2)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("h5")
    write_file(folder / "record_dataset_Alpha.h5", LENGTHS, videos=VIDEOS, size=64)
    return folder


def publish(root: Path, recordings: Path, image_format: str, order: tuple[int, ...]) -> Path:
    """A dataset of these recordings in the published columns, at 10 frames per second, without
    demonstration flags.
    """
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from mme_vla.data.hdf5 import open_episode

    view = {"dtype": image_format, "shape": (64, 64, 3), "names": ["height", "width", "channel"]}
    features = {
        "image": view,
        "wrist_image": view,
        "state": VECTOR,
        "actions": VECTOR,
        "simple_subgoal": TEXT,
    }
    as_video = image_format == "video"
    dataset = LeRobotDataset.create(
        "lerobot/robomme",
        10,
        features,
        root=root,
        robot_type="panda",
        use_videos=as_video,
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec="libsvtav1", crf=30, pix_fmt="yuv420p")
        if as_video
        else None,
    )
    refs = list_episodes(find_files([recordings]))
    for number in order:
        with open_episode(refs[number]) as episode:
            for frame in episode:
                dataset.add_frame(
                    {
                        "image": frame.front,
                        "wrist_image": frame.wrist,
                        "state": frame.state,
                        "actions": frame.action.astype(np.float32),
                        "simple_subgoal": frame.subgoals["simple_subgoal"],
                        "task": episode.goals[0],
                    }
                )
        dataset.save_episode()
    dataset.finalize()
    return root


@pytest.fixture(scope="module")
def av1(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes 2, 0 and 1 of the recordings, as videos."""
    return publish(
        tmp_path_factory.mktemp("published") / "av1", recordings, "video", order=(2, 0, 1)
    )


@pytest.fixture(scope="module")
def tables(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes 1, 2 and 0 of the recordings, as images in the tables."""
    return publish(
        tmp_path_factory.mktemp("published") / "tables", recordings, "image", order=(1, 2, 0)
    )


@pytest.fixture(scope="module")
def converted(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recordings as this library converts them."""
    folder = tmp_path_factory.mktemp("converted") / "dataset"
    convert(list_episodes(find_files([recordings])), folder, ConvertOptions(images="png"))
    return folder


def make_side_file(recordings: Path, dataset: Path, output: Path) -> Path:
    words = [f"input={recordings}", f"dataset={dataset}", f"output={output}"]
    main(compose("exec_starts", words))
    return output


def test_videos_in_av1_without_flags_are_read_with_a_side_file(
    tmp_path: Path, recordings: Path, av1: Path
) -> None:
    with pytest.raises(UserError, match="does not mark its conditioning videos"):
        EpisodeSource(av1)
    starts = make_side_file(recordings, av1, tmp_path / "starts.json")
    assert json.loads(starts.read_text()) == {"0": 2, "1": 4, "2": 0}
    source = EpisodeSource(av1, exec_starts=starts)
    assert source.exec_starts.tolist() == [2, 4, 0] and source.fps == 10
    assert source.frames(0, [0, 8]).shape == (2, 64, 64, 3)
    assert set(source.lossy) == {"front", "wrist"} and source.lossy["front"].startswith("av1")
    with pytest.raises(UserError, match="exists: name a new file"):
        make_side_file(recordings, av1, starts)


def test_a_memory_that_scores_patches_is_warned_of_lossy_videos(
    tmp_path: Path, av1: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "starts.json").write_text('{"0": 2, "1": 4, "2": 0}')
    source = EpisodeSource(av1, exec_starts=tmp_path / "starts.json")
    for model, warned in (("tokendrop_modul", True), ("framesamp_modul", False)):
        caplog.clear()
        policy = small_policy(model)
        with caplog.at_level(logging.WARNING):
            ensure_cache(
                source, policy.require_memory(), policy.encode_frames, "x", root=tmp_path / "cache"
            )
        assert ("passes for motion" in caplog.text) == warned


def test_images_inside_the_tables_are_read_as_they_are(
    tmp_path: Path, tables: Path, converted: Path
) -> None:
    (tmp_path / "starts.json").write_text('{"0": 0, "1": 2, "2": 4}')
    source = EpisodeSource(tables, exec_starts=tmp_path / "starts.json")
    assert source.video_cameras == () and source.lossy == {}
    expected = EpisodeSource(converted)
    np.testing.assert_array_equal(
        source.frames(1, range(9), "wrist"), expected.frames(2, range(9), "wrist")
    )


def test_only_the_nearest_recordings_must_agree_on_the_start(tables: Path, converted: Path) -> None:
    others = annotated_episodes([converted])
    (first,) = [one for one in others if one.start == 4]
    others.remove(first)
    variants = []
    for start, apart in enumerate([2.4e-6, 1.6e-6, 0.8e-6]):
        variants.append(replace(first, joints=first.joints.astype(np.float64) + apart, start=start))
    assert first_frames(tables, [variants[0], variants[2], *others]) == [0, 2, 2]
    with pytest.raises(UserError, match=r"recordings that fit alike begin at 1, 2\."):
        first_frames(tables, [*variants, *others])


def test_our_demonstrations_mark_videos_too_and_unauthenticated_clients_are_named(
    tmp_path: Path, tables: Path, converted: Path
) -> None:
    assert first_frames(tables, annotated_episodes([converted])) == [0, 2, 4]
    write_file(tmp_path / "record_dataset_AnotherSeed.h5", LENGTHS, videos=VIDEOS, size=16)
    with pytest.raises(
        UserError, match=r"episode 0 .*is not among the 3 episodes given: the nearest is .* rad"
    ):
        first_frames(tables, annotated_episodes([tmp_path]))
