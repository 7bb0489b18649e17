"""A dataset is compared with itself when it is opened: contradictions are errors that name both
sides.
"""

import json
import logging
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers.lerobot_tables import (
    CAMERA,
    EPISODES,
    FPS,
    ROWS,
    SHADE,
    VIDEO,
    cell,
    change,
    change_info,
    custom_robot,
    grey_image,
    table,
    write_dataset,
    write_video,
)
from mme_vla.data.episode_table import Description
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.lerobot_files import (
    SAMPLE,
    Feature,
    Info,
    content_fingerprint,
    parquet_files,
)
from mme_vla.data.sources import open_sources
from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError

TASKS = ("open the drawer", "close the drawer")


def opened(root: Path, **action: Any) -> EpisodeSource:
    return EpisodeSource(root, robot=custom_robot(**action))


def frames_read(source: EpisodeSource, episode: int) -> list[int]:
    """Which frames of the dataset an episode's pictures are."""
    images = source.frames(episode, np.arange(source.lengths[episode]))
    return [round(float(image.mean()) / SHADE) for image in images]


@pytest.mark.parametrize("video", [False, True])
def test_a_dataset_without_faults_opens_without_a_word(tmp_path: Path, video: bool, caplog) -> None:
    source = opened(write_dataset(tmp_path, video=video))
    assert [source.goal(episode) for episode in (0, 1)] == list(TASKS)
    assert frames_read(source, 1) == [5, 6, 7, 8]
    assert not caplog.text


# Tasks


@pytest.mark.parametrize(
    "listed",
    [
        None,
        pa.array([[], []], pa.list_(pa.string())),
        pa.array(TASKS),
        pa.array([None, None], pa.string()),
    ],
    ids=["no column", "empty lists", "one text", "nothing"],
)
def test_tasks_are_read_by_task_index_where_episodes_do_not_list_them_as_lerobot_does(
    tmp_path: Path, listed
) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    change(write_dataset(tmp_path / "data"), EPISODES, "tasks", listed)
    source = opened(tmp_path / "data")
    reference = LeRobotDataset("local/data", root=tmp_path / "data", video_backend="pyav")
    for row in range(9):
        assert source.goal(*source.locate(row)) == reference[row]["task"]
    assert [source.goals(episode) for episode in (0, 1)] == [(TASKS[0],), (TASKS[1],)]


def test_the_goal_of_a_frame_is_its_own_task(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    change(tmp_path, ROWS, "task_index", [0, 0, 1, 1, 0, 1, 1, 1, 1])
    change(tmp_path, EPISODES, "tasks", [list(TASKS), [TASKS[1]]])
    source = opened(tmp_path)
    assert [source.goal(0, frame) for frame in range(5)] == [TASKS[i] for i in (0, 0, 1, 1, 0)]
    assert source.goals(0) == TASKS and source.goal(1) == TASKS[1]
    with pytest.raises(
        UserError, match=r"episode 0 have 2 tasks: 'open the drawer', 'close the drawer'"
    ):
        source.goal(0)


def test_a_training_step_has_the_goal_of_its_frame(tmp_path: Path) -> None:
    from mme_vla.data.dataset import TrainingDataset
    from mme_vla.processing.processor import Processor
    from mme_vla.processing.tokenizer import Tokenizer
    from mme_vla.testing.small import unit_stats

    write_dataset(tmp_path)
    change(tmp_path, ROWS, "task_index", [0, 0, 1, 1, 1, 1, 1, 1, 1])
    change(tmp_path, EPISODES, "tasks", [list(TASKS), [TASKS[1]]])
    source = opened(tmp_path)
    processor = Processor(
        32, Tokenizer.load("sample"), embodiment=source.robot, stats=unit_stats(source.robot)
    )
    steps = TrainingDataset([source], processor)
    assert [steps.step(i).goal for i in range(4)] == [TASKS[0], TASKS[0], TASKS[1], TASKS[1]]


def test_what_tasks_are_listed_and_what_rows_say_must_agree(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    change(tmp_path, ROWS, "task_index", [1] * 5 + [0] * 4)
    with pytest.raises(
        UserError, match=r"row 0, frame 0 of episode 0, has task_index 1, 'close .*open the drawer"
    ):
        opened(tmp_path)
    change(tmp_path, ROWS, "task_index", [0] * 5 + [7] * 4)
    with pytest.raises(
        UserError, match=r"frame 0 of episode 1, has task_index 7, but .* holds 2 tasks"
    ):
        opened(tmp_path)
    change(tmp_path, ROWS, "task_index", None)
    assert opened(tmp_path).goal(1) == TASKS[1]
    change(tmp_path, EPISODES, "tasks", [list(TASKS), [TASKS[1]]])
    with pytest.raises(UserError, match=r"tasks of episode 0 is .*no task_index"):
        opened(tmp_path)


def test_a_table_of_tasks_that_numbers_them_otherwise_than_by_row_is_refused(
    tmp_path: Path,
) -> None:
    write_dataset(tmp_path)
    index = pd.Index(TASKS[::-1], name="task")
    pd.DataFrame({"task_index": [1, 0]}, index=index).to_parquet(
        tmp_path / "meta" / "tasks.parquet"
    )
    with pytest.raises(UserError, match=r"row 0, 'close the drawer', has task_index 1"):
        opened(tmp_path)


@pytest.mark.parametrize("task", ["", "  \n", "\u200b", "pick\0up", "open \x1b[31mit"])
def test_a_goal_without_words_or_with_control_characters_is_refused(
    tmp_path: Path, task: str
) -> None:
    write_dataset(tmp_path, tasks=(TASKS[0], task))
    with pytest.raises(UserError, match=r"the task '.*' is empty or holds control characters"):
        opened(tmp_path)


@pytest.mark.parametrize("task", ["lift it\r\nslowly", "در را ب\u200cاز کن", "打开抽屉"])
def test_goals_of_several_lines_and_of_any_language_are_read(tmp_path: Path, task: str) -> None:
    assert opened(write_dataset(tmp_path, tasks=(TASKS[0], task))).goal(1) == task


def test_the_fingerprint_follows_the_table_of_tasks_where_goals_come_from_it(
    tmp_path: Path,
) -> None:
    write_dataset(tmp_path)
    listed = opened(tmp_path).fingerprint
    assert listed == content_fingerprint(tmp_path)  # as before
    change(tmp_path, EPISODES, "tasks", None)
    before = opened(tmp_path).fingerprint
    index = pd.Index(["lift the lid", TASKS[1]], name="task")
    pd.DataFrame({"task_index": [0, 1]}, index=index).to_parquet(
        tmp_path / "meta" / "tasks.parquet"
    )
    assert opened(tmp_path).fingerprint != before


# Rows


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        (
            "frame_index",
            [0, 1, 4, 5, 6, 0, 1, 2, 3],
            r"row 2, frame 2 of episode 0, has frame_index 4; .* it is 2",
        ),
        (
            "frame_index",
            [0, 1, 2, 3, 4, 1, 2, 3, 4],
            r"row 5, frame 0 of episode 1, has frame_index 1",
        ),
        ("frame_index", [0, 1, 1, 3, 4, 0, 1, 2, 3], r"has frame_index 1; by its place it is 2"),
        (
            "index",
            [0, 1, 2, 3, 4, 0, 1, 2, 3],
            r"row 5, frame 0 of episode 1, has index 0; by its place it is 5",
        ),
        ("index", list(range(8, -1, -1)), r"has index 8; by its place it is 0"),
        ("timestamp", [i / 9 for i in [*range(5), *range(4)]], "none"),  # within half a frame
        (
            "timestamp",
            [0, 0.1, 0.26, 0.3, 0.4, 0, 0.1, 0.2, 0.3],
            r"row 2, .*timestamp 0.2600 s; at fps=10 .*0.2000 s",
        ),
        ("timestamp", [3.0, 3.1, 3.2, 3.3, 3.4, 0, 0.1, 0.2, 0.3], r"row 0, .*timestamp 3.0000 s"),
        (
            "timestamp",
            [0, 0.1, float("nan"), 0.3, 0.4, 0, 0.1, 0.2, 0.3],
            r"row 2, .*timestamp nan",
        ),
    ],
)
def test_rows_that_contradict_their_place_are_named(
    tmp_path: Path, name: str, values: list, words: str
) -> None:
    write_dataset(tmp_path)
    change(tmp_path, ROWS, name, values)
    if words == "none":
        assert len(opened(tmp_path)) == 2
        return
    with pytest.raises(UserError, match=words):
        opened(tmp_path)


def test_a_clock_that_drifts_away_from_the_rate_is_named_at_the_first_row_that_is_another_frame(
    tmp_path: Path,
) -> None:
    write_dataset(tmp_path, lengths=(40,), tasks=TASKS[:1], video=True)
    change(tmp_path, ROWS, "timestamp", np.float32(np.arange(40) / 9))
    with pytest.raises(UserError, match=r"row 5, .*0.5556 s; .*0.5000 s.*35 such rows"):
        opened(tmp_path)


def test_rows_in_reverse_are_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    rows = pq.ParquetFile(tmp_path / ROWS).read()
    pq.write_table(rows.take(pa.array([4, 3, 2, 1, 0, 5, 6, 7, 8])), tmp_path / ROWS)
    with pytest.raises(UserError, match="row 0, frame 0 of episode 0, has frame_index 4"):
        opened(tmp_path)


@pytest.mark.parametrize("fps", [29.97, 30, 50])
def test_rounded_time_stamps_of_long_episodes_are_in_order(tmp_path: Path, fps: float) -> None:
    from mme_vla.data import consistency

    frames = np.arange(3 * 3600 * int(fps))  # three hours in float32
    lengths = np.array([len(frames)])
    info = Info(features={}, fps=fps)
    dataset = Description(tmp_path, info, np.array([0]), lengths, [()], None, {}, ())
    rows = {"episode_index": np.zeros_like(frames)}
    rows["timestamp"] = np.float32(frames / fps).astype(np.float64)
    consistency._check_rows(dataset, rows)
    rows["timestamp"] = frames / fps * 1.001
    with pytest.raises(UserError, match="timestamp"):
        consistency._check_rows(dataset, rows)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (
            lambda info: info.update(total_episodes=3),
            "total_episodes is 3, but meta/episodes describes 2",
        ),
        (
            lambda info: info.update(total_frames=8),
            "total_frames is 8, but meta/episodes describes 9",
        ),
    ],
)
def test_totals_of_the_description_must_agree(tmp_path: Path, edit, words: str) -> None:
    change_info(write_dataset(tmp_path), edit)
    with pytest.raises(UserError, match=words):
        opened(tmp_path)


def test_the_length_of_an_episode_must_be_that_of_its_rows(tmp_path: Path) -> None:
    change(write_dataset(tmp_path), EPISODES, "length", [5, 3])
    with pytest.raises(UserError, match=r"episode 1 has length 3, but .* give it 4 rows"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("key", "value"), [("length", 9), ("exec_start_idx", 3), ("episode_index", 2)]
)
def test_the_file_beside_the_tables_must_agree_with_them(
    tmp_path: Path, key: str, value: int
) -> None:
    root = tmp_path / "copy"
    shutil.copytree(SAMPLE, root)
    path = root / "meta" / "robomme_episodes.json"
    side = json.loads(path.read_text())
    side["episodes"][1][key] = value
    path.write_text(json.dumps(side))
    with pytest.raises(UserError, match=rf"{key} of episode 1 is {value}; the tables say"):
        EpisodeSource(root)


def test_both_marks_of_a_conditioning_video_must_agree(tmp_path: Path) -> None:
    root = tmp_path / "copy"
    shutil.copytree(SAMPLE, root)
    rows = pq.ParquetFile(root / ROWS).read()["exec_start_idx"].to_pylist()
    change(root, ROWS, "exec_start_idx", pa.array([60, *rows[1:]], pa.int32()))
    with pytest.raises(
        UserError, match=r"row 0, .* has exec_start_idx 60, but is_demo marks the first 66 frames"
    ):
        EpisodeSource(root)


def add_flag(root: Path, name: str, values: list) -> None:
    change(root, ROWS, name, values)
    feature = {"dtype": "int64", "shape": [1], "names": None}
    change_info(root, lambda info: info["features"].update({name: feature}))


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        (
            "exec_start_idx",
            [1, 1, 3, 1, 1, 0, 0, 0, 0],
            "exec_start_idx 3, but 1 at the first",
        ),
        ("is_demo", [1, 0, 0, 0, 0, 1, 2, 0, 0], r"frame 1 of episode 1, has is_demo 2"),
        ("is_demo", [-1, 1, 0, 0, 0, 0, 0, 0, 0], r"frame 0 of episode 0, has is_demo -1"),
        ("top_drawn", [1, 1, 1, 1, 1, 1, 1, 1, 3], r"frame 3 of episode 1, has top_drawn 3"),
    ],
)
def test_a_flag_says_one_thing_of_an_episode(tmp_path: Path, name, values, words) -> None:
    add_flag(write_dataset(tmp_path), name, values)
    with pytest.raises(UserError, match=words):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("name", "values"),
    [("is_demo", [1, 1, 0, 0, 0, 0, 0, 0, 0]), ("exec_start_idx", [2, 2, 2, 2, 2, 0, 0, 0, 0])],
)
def test_a_side_file_of_first_execution_frames_must_agree_with_the_tables(
    tmp_path: Path, name, values
) -> None:
    add_flag(write_dataset(tmp_path / "data"), name, values)
    starts = tmp_path / "starts.json"
    starts.write_text('{"0": 2, "1": 0}')
    source = EpisodeSource(tmp_path / "data", starts, robot=custom_robot())
    assert source.exec_starts.tolist() == [2, 0]
    starts.write_text('{"0": 2, "1": 3}')
    with pytest.raises(UserError, match=r"episode 1 starts execution at frame 3, but .* at 0"):
        EpisodeSource(tmp_path / "data", starts, robot=custom_robot())


def test_a_side_file_names_one_first_execution_frame_an_episode(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    (tmp_path / "starts.json").write_text('{"0": 4, "1": 1, "00": 2}')
    table(tmp_path / "starts.parquet", {"episode_index": [0, 1, 0], "exec_start_idx": [4, 1, 2]})
    for name in ("starts.json", "starts.parquet"):
        with pytest.raises(UserError, match="episode 0 two first execution frames, 4 and 2"):
            EpisodeSource(tmp_path / "data", tmp_path / name, robot=custom_robot())


def test_other_statistics_than_the_rows_have_are_a_warning(tmp_path: Path, caplog) -> None:
    write_dataset(tmp_path)
    stats = {"action": {"min": [-9.0] * 3, "max": [9.0] * 3}}
    (tmp_path / "meta" / "stats.json").write_text(json.dumps(stats))
    opened(tmp_path)
    assert "number 1 of action lies within -9 and 9, in the rows within" in caplog.text


# Columns and sources


@pytest.mark.parametrize(
    ("edit", "column"),
    [
        (lambda robot: robot["cameras"].update(side={"key": CAMERA}), CAMERA),
        (lambda robot: robot["state"].update(key="action"), "action"),
    ],
)
def test_a_column_that_is_read_twice_is_a_warning(
    tmp_path: Path, caplog, edit, column: str
) -> None:
    section = custom_robot().to_dict()
    edit(section)
    EpisodeSource(write_dataset(tmp_path), robot=Embodiment.from_dict(section))
    assert f"reads {column} more than once" in caplog.text


def test_numbers_in_a_column_of_flags_are_not_taken_for_one(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    change_info(tmp_path, lambda info: info["features"]["action"].update(dtype="bool"))
    with pytest.raises(UserError, match=r"action is bool in meta/info.json, .* holds .*float"):
        opened(tmp_path)


def test_two_sources_of_one_content_are_a_warning(tmp_path: Path, caplog) -> None:
    write_dataset(tmp_path / "one")
    shutil.copytree(tmp_path / "one", tmp_path / "two")
    write_dataset(tmp_path / "three", states=np.random.default_rng(3).normal(size=(9, 3)))
    open_sources([str(tmp_path / "one"), str(tmp_path / "three")], custom_robot())
    assert not caplog.text
    open_sources([str(tmp_path / name) for name in ("one", "two")], custom_robot())
    assert "what is held out of one" in caplog.text and "two/0 as one/0, two/1 as" in caplog.text


# Videos


def test_pictures_are_right_up_to_a_drift_of_half_a_frame_and_refused_beyond(
    tmp_path: Path,
) -> None:
    write_dataset(tmp_path, video=True)
    for drift, right in (
        (0.0, True),
        (0.4, True),
        (-0.4, True),
        (0.6, False),
        (1.0, False),
        (-0.6, False),
    ):
        begins = np.array([0, 0.5 + drift / FPS])
        change(tmp_path, EPISODES, f"videos/{CAMERA}/from_timestamp", begins)
        change(tmp_path, EPISODES, f"videos/{CAMERA}/to_timestamp", begins + np.array([5, 4]) / FPS)
        if right:
            assert frames_read(opened(tmp_path), 1) == [5, 6, 7, 8]
            continue
        with pytest.raises(
            UserError, match=r"of episode 1 is looked for at|episodes 0 and 1 overlap"
        ):
            opened(tmp_path)


def test_episodes_that_share_pictures_are_named(tmp_path: Path) -> None:
    write_dataset(tmp_path, video=True)
    change(tmp_path, EPISODES, f"videos/{CAMERA}/from_timestamp", [0.0, 0.0])
    change(tmp_path, EPISODES, f"videos/{CAMERA}/to_timestamp", [0.5, 0.4])
    with pytest.raises(
        UserError, match=r"episodes 0 and 1 overlap in the video file-000.mp4 of observation"
    ):
        opened(tmp_path)


def test_the_end_of_a_span_must_be_where_its_frames_end(tmp_path: Path) -> None:
    write_dataset(tmp_path, video=True)
    change(tmp_path, EPISODES, f"videos/{CAMERA}/to_timestamp", [0.5, 1.0])
    with pytest.raises(
        UserError, match=r"episode 1 lie between 0.5000 s and 1.0000 s, 5.00 frames .* has 4 frames"
    ):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("frames", "rate", "words"),
    [
        (7, FPS, "with 7 pictures to 0.6000 s for 9 rows"),  # two short
        (9, 9, "frame . of episode . is looked for at"),  # of another rate
        (9, 20, "frame . of episode . is looked for at"),
    ],
)
def test_a_video_that_does_not_hold_the_rows_is_refused_on_opening(
    tmp_path: Path, frames, rate, words
) -> None:
    write_dataset(tmp_path, video=True)
    write_video(tmp_path / VIDEO, [grey_image(SHADE * i) for i in range(frames)], rate)
    with pytest.raises(UserError, match=words):
        opened(tmp_path)


def test_a_video_with_more_pictures_than_rows_is_read_where_they_lie(tmp_path: Path) -> None:
    write_dataset(tmp_path, video=True)
    write_video(tmp_path / VIDEO, [grey_image(SHADE * i) for i in range(12)])
    change(tmp_path, EPISODES, f"videos/{CAMERA}/from_timestamp", [0.0, 0.7])
    change(tmp_path, EPISODES, f"videos/{CAMERA}/to_timestamp", [0.5, 1.1])
    assert frames_read(opened(tmp_path), 1) == [7, 8, 9, 10]
    twice = [grey_image(SHADE * (i // 2)) for i in range(18)]  # twice as many a second
    write_video(tmp_path / VIDEO, twice, 2 * FPS)
    change(tmp_path, EPISODES, f"videos/{CAMERA}/from_timestamp", [0.0, 0.5])
    change(tmp_path, EPISODES, f"videos/{CAMERA}/to_timestamp", [0.5, 0.9])
    assert frames_read(opened(tmp_path), 1) == [5, 6, 7, 8]


def test_a_rate_that_is_no_whole_number_is_read(tmp_path: Path) -> None:
    write_dataset(tmp_path, lengths=(6, 6), video=True, fps=29.97)
    assert frames_read(opened(tmp_path), 1) == [6, 7, 8, 9, 10, 11]


def test_a_missing_video_and_pictures_of_another_size_are_noticed_on_opening(
    tmp_path: Path, caplog
) -> None:
    write_dataset(tmp_path, video=True)
    change_info(tmp_path, lambda info: info["features"][CAMERA].update(shape=[64, 64, 3]))
    opened(tmp_path)
    assert "the shape [64, 64, 3], but its pictures have 32 rows and 32 columns" in caplog.text
    (tmp_path / VIDEO).unlink()
    with pytest.raises(UserError, match=r"file-000.mp4 is missing"):
        opened(tmp_path)


# Depth and numbers


@pytest.mark.parametrize("key", ["info", "video_info"])
@pytest.mark.parametrize(
    "about", [{"is_depth_map": True}, {"video.is_depth_map": True}, {"video.pix_fmt": "gray12le"}]
)
def test_a_camera_described_as_depth_is_refused(tmp_path: Path, key: str, about: dict) -> None:
    write_dataset(tmp_path)
    change_info(tmp_path, lambda info: info["features"][CAMERA].update({key: about}))
    with pytest.raises(UserError, match=r"observation.images.top holds depth"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("image", "kind", "words"),
    [
        (np.full((32, 32), 600, np.uint16), "png", "16-bit"),
        (np.full((32, 32), 0.1, np.float32), "tiff", "floating-point"),
        (np.full((32, 32), 70000, np.int32), "tiff", "32-bit"),
    ],
)
def test_pictures_of_more_than_eight_bits_are_refused_wherever_they_are(
    tmp_path: Path, image, kind, words
) -> None:
    write_dataset(tmp_path)
    cells = [cell(grey_image(0))] * 9
    change(tmp_path, ROWS, CAMERA, pa.array([cells[0]] * 5 + [cell(image, kind)] + cells[:3]))
    with pytest.raises(UserError, match=rf"observation.images.top holds depth.*{words}"):
        opened(tmp_path)
    change(tmp_path, ROWS, CAMERA, pa.array([cells[0]] * 2 + [cell(image, kind)] + cells[:6]))
    with pytest.raises(UserError, match=words):
        opened(tmp_path).frames(0, [1, 2])


def test_grey_pictures_of_eight_bits_are_colours(tmp_path: Path) -> None:
    write_dataset(tmp_path)
    change(
        tmp_path,
        ROWS,
        CAMERA,
        pa.array([cell(np.full((32, 32), SHADE * i, np.uint8)) for i in range(9)]),
    )
    assert frames_read(opened(tmp_path), 0) == [0, 1, 2, 3, 4]


def test_a_video_of_deep_grey_is_refused_whatever_is_written_of_it(tmp_path: Path) -> None:
    write_dataset(tmp_path, video=True)
    depth = [np.full((32, 32), 300 * i, np.uint16) for i in range(9)]
    write_video(tmp_path / VIDEO, depth, pixel_format="gray12le", coder="libx265")
    with pytest.raises(UserError, match=r"holds depth.*stored as gray12le"):
        opened(tmp_path)


@pytest.mark.parametrize("column", ["action", "observation.state"])
@pytest.mark.parametrize("value", [1e39, -4e38, math.nan])
def test_numbers_beyond_float32_are_named(tmp_path: Path, column: str, value: float) -> None:
    write_dataset(tmp_path)
    change_info(tmp_path, lambda info: info["features"][column].update(dtype="float64"))
    numbers = np.zeros((9, 3))
    numbers[3, 1] = value
    change(tmp_path, ROWS, column, pa.array(numbers.tolist(), pa.list_(pa.float64(), 3)))
    with pytest.raises(UserError, match=rf"row 3 has {column} \S* for number 2; .* float32"):
        opened(tmp_path)


# Names and units


def test_the_same_names_in_another_order_are_refused_and_other_names_named(
    tmp_path: Path, caplog
) -> None:
    names = ["shoulder", "elbow", "gripper"]
    roots = [
        write_dataset(
            tmp_path / str(i), names=other, states=np.random.default_rng(i).random((9, 3))
        )
        for i, other in enumerate(
            (names, ["elbow", "shoulder", "gripper"], {"motors": names}, ["hip", "knee", "toe"])
        )
    ]
    with pytest.raises(
        UserError, match=r"another order\. the source 0: shoulder, elbow.*the source 1: elbow"
    ):
        open_sources([str(roots[0]), str(roots[1])], custom_robot())
    assert len(open_sources([str(roots[0]), str(roots[2])], custom_robot())) == 2
    assert not caplog.text
    open_sources([str(roots[0]), str(roots[3])], custom_robot())
    assert (
        "have different names. the source 0: shoulder, elbow, gripper; the source 3: hip"
        in caplog.text
    )


def test_the_robots_names_are_compared_with_the_datasets(tmp_path: Path, caplog) -> None:
    write_dataset(tmp_path, names=["Shoulder", "el_bow", "gripper"])
    assert (
        opened(tmp_path, names=["shoulder", "el bow", "Gripper"]).robot.action.names[1] == "el bow"
    )
    with pytest.raises(
        UserError, match=r"numbers of the action have the same names in another order.*desk arm"
    ):
        opened(tmp_path, names=["el bow", "shoulder", "gripper"])
    assert not caplog.text
    opened(tmp_path, names=["a", "b", "c"])
    assert "different names" in caplog.text


def test_actions_relative_to_states_in_another_order_are_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path, names=["a", "b", "c"])
    change_info(
        tmp_path, lambda info: info["features"]["observation.state"].update(names=["b", "a", "c"])
    )
    assert len(opened(tmp_path)) == 2
    with pytest.raises(UserError, match="subtracted from each other"):
        opened(tmp_path, relative=[0, 1])


def test_sources_of_other_rates_and_other_units_are_noticed(tmp_path: Path, caplog) -> None:
    states = np.random.default_rng(1).normal(size=(9, 3))
    first = write_dataset(tmp_path / "first", states=states)
    second = write_dataset(tmp_path / "second", states=np.degrees(states), fps=30)
    third = write_dataset(tmp_path / "third", states=3 * states)
    open_sources([str(first), str(third)], custom_robot())
    assert not caplog.text
    open_sources([str(first), str(second)], custom_robot())
    assert "first has 10 frames per second, second has 30" in caplog.text
    assert "have other units than in episode first/0" in caplog.text
    assert "second/0, second/1" in caplog.text


def test_numbers_too_large_for_the_robots_unit_are_noticed(tmp_path: Path, caplog) -> None:
    write_dataset(tmp_path, states=np.full((9, 3), 90.0))
    opened(tmp_path, units=["deg", "", "mm"])
    assert not caplog.text
    opened(tmp_path, units=["rad", "", "m"])
    assert (
        "the action's number 1 reaches 90.1, which is hardly in rad" in caplog.text
        and "(2 such" in caplog.text
    )


# Layout and caches


def test_what_is_known_of_a_video_is_read_under_both_names() -> None:
    about = {"video.codec": "av1", "video.crf": 30}
    for parts in ({"info": about}, {"video_info": about}, {"info": {}, "video_info": about}):
        assert Feature(dtype="video", shape=(8, 8, 3), **parts).lossy_coding == "av1 at crf 30"
    assert Feature(dtype="video", shape=(8, 8, 3)).lossy_coding is None


@pytest.mark.parametrize("folder", ["data", "meta/episodes"])
def test_files_are_ordered_by_their_numbers(tmp_path: Path, folder: str) -> None:
    write_dataset(tmp_path)
    path = tmp_path / folder / "chunk-000" / "file-000.parquet"
    reference = pq.ParquetFile(path).read()
    path.unlink()
    cut = 5 if folder == "data" else 1
    for chunk, number, part in (
        ("chunk-999", 999, reference.slice(0, cut)),
        ("chunk-1000", 1000, reference.slice(cut)),
    ):
        table(
            tmp_path / folder / chunk / f"file-{number}.parquet",
            {n: part[n] for n in part.column_names},
        )
    source = opened(tmp_path)
    assert source.states(0)[0].tolist() == pytest.approx(whole_state(tmp_path, folder))
    assert frames_read(source, 1) == [5, 6, 7, 8]


def test_words_in_the_names_of_files_come_before_their_numbers(tmp_path: Path) -> None:
    names = ["a-9/file-000", "a-10/file-000", "b-1/file-2", "b-1/file-10", "c/file-000"]
    for name in names:
        table(tmp_path / "data" / f"{name}.parquet", {"index": [0]})
    read = [path.relative_to(tmp_path / "data") for path in parquet_files(tmp_path, "data")]
    assert [path.with_suffix("").as_posix() for path in read] == names


def whole_state(root: Path, folder: str) -> list[float]:
    file = root / ("data/chunk-999/file-999.parquet" if folder == "data" else ROWS)
    return list(pq.ParquetFile(file).read()["observation.state"][0].as_py())


def test_files_that_macos_leaves_are_not_the_datasets(tmp_path: Path) -> None:
    write_dataset(tmp_path, video=True)
    fingerprint = opened(tmp_path).fingerprint
    for file in (ROWS, EPISODES, VIDEO, "meta/tasks.parquet"):
        path = tmp_path / file
        path.with_name(f"._{path.name}").write_bytes(b"\x00\x05\x16\x07")
    assert opened(tmp_path).fingerprint == fingerprint


def test_a_missing_column_is_named_and_not_called_damage(tmp_path: Path) -> None:
    change(write_dataset(tmp_path, video=True), EPISODES, f"videos/{CAMERA}/file_index", None)
    with pytest.raises(UserError, match=r"lacks videos/observation.images.top/file_index") as error:
        opened(tmp_path)
    assert "damaged" not in str(error.value)


def test_rows_without_the_number_of_their_episode_are_refused(tmp_path: Path) -> None:
    change(write_dataset(tmp_path), ROWS, "episode_index", None)
    with pytest.raises(UserError, match="has the column episode_index"):
        opened(tmp_path)


def test_rows_of_other_episodes_than_described_are_named(tmp_path: Path) -> None:
    change(write_dataset(tmp_path), ROWS, "episode_index", [0, 0, 0, 0, 1, 1, 1, 1, 1])
    with pytest.raises(UserError, match=r"row 4, .* has episode_index 1; by its place it is 0"):
        opened(tmp_path)


def declare(root: Path, name: str, dtype: str = "bool") -> None:
    feature = {"dtype": dtype, "shape": [1], "names": None}
    change_info(root, lambda info: info["features"].update({name: feature}))


@pytest.mark.parametrize("flag", ["is_demo", "exec_start_idx", "top_drawn"])
def test_a_declared_flag_that_one_file_lacks_is_named(tmp_path: Path, flag: str) -> None:
    change(write_dataset(tmp_path), ROWS, flag, [0] * 9)
    declare(tmp_path, flag, "int64")
    opened(tmp_path)
    full = pq.ParquetFile(tmp_path / ROWS).read()
    pq.write_table(full.slice(0, 5), tmp_path / ROWS)
    other = tmp_path / ROWS.replace("file-000", "file-001")
    pq.write_table(full.slice(5).drop_columns([flag]), other)
    with pytest.raises(UserError, match=f"declares {flag}, which not every file in data/ has"):
        opened(tmp_path)


@pytest.mark.parametrize("flag", ["is_demo", "exec_start_idx", "top_drawn"])
@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ([[0, 0], [], *[[0]] * 7], "holds lists; expected one number a row"),
        ([[0, 0]] * 9, "holds lists; expected one number a row"),
        ([[None], *[[0]] * 8], "is missing in 1 row"),
        (["yes"] * 9, "cannot be read as numbers"),
        ([0.5] * 9, "cannot be read as numbers"),
    ],
)
def test_a_flag_of_another_form_than_one_number_a_row_is_refused(
    tmp_path: Path, flag: str, cells: list[Any], message: str
) -> None:
    change(write_dataset(tmp_path), ROWS, flag, cells)
    declare(tmp_path, flag)
    with pytest.raises(UserError, match=message):
        opened(tmp_path)


@pytest.mark.parametrize("name", ["is_demo", "exec_start_idx", "top_drawn", "episode_index"])
def test_a_flag_declared_as_another_type_than_whole_numbers_is_refused(
    tmp_path: Path, name: str
) -> None:
    declare(write_dataset(tmp_path), name, "float32")
    with pytest.raises(UserError, match=f"{name} is 'float32'; expected whole numbers"):
        opened(tmp_path)


@pytest.mark.parametrize("video", [False, True])
def test_replaced_tables_are_read_though_time_and_size_are_kept(
    tmp_path: Path, video: bool
) -> None:
    root = tmp_path / "data"
    write_dataset(root, video=video, states=np.full((9, 3), 1.0))
    before = (root / ROWS).stat()
    assert opened(root).states(0)[0, 0] == 1
    write_dataset(tmp_path / "other", video=video, states=np.full((9, 3), 2.0))
    shutil.copy(tmp_path / "other" / ROWS, root / ROWS)
    os.utime(root / ROWS, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert opened(root).states(0)[0, 0] == 2


@pytest.mark.slow
def test_a_change_in_the_middle_of_a_large_table_is_read(tmp_path: Path) -> None:
    """The fingerprint reads three places of a file; the numbers are never taken on its word."""
    total = 40_000
    states = np.random.default_rng(2).normal(size=(total, 3))
    write_dataset(tmp_path, lengths=(total,), tasks=TASKS[:1], video=True, states=states)
    times = (tmp_path / ROWS).stat()
    source = opened(tmp_path)
    content = bytearray((tmp_path / ROWS).read_bytes())
    value = np.float32(source.states(0)[:, 0])
    place = next(
        at
        for at in range(len(value))
        if 70_000 < content.find(value[at].tobytes()) < len(content) // 3
    )
    at = content.find(value[place].tobytes())
    content[at : at + 4] = np.float32(0.125).tobytes()
    (tmp_path / ROWS).write_bytes(content)
    os.utime(tmp_path / ROWS, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert not np.array_equal(opened(tmp_path).states(0), source.states(0))


def test_inspecting_names_the_contradiction(tmp_path: Path, monkeypatch, capsys) -> None:
    from mme_vla.cli import run

    root = tmp_path / "copy"
    shutil.copytree(SAMPLE, root)
    rows = pq.ParquetFile(root / ROWS).read()["frame_index"].to_pylist()
    change(root, ROWS, "frame_index", [7, *rows[1:]])
    monkeypatch.setattr("sys.argv", ["inspect", f"dataset={root}"])
    with pytest.raises(SystemExit):
        run("inspect")
    assert "has frame_index 7" in capsys.readouterr().err


@pytest.mark.slow
def test_datasets_that_lerobot_edited_are_in_order(tmp_path: Path, caplog) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    reference = LeRobotDataset("local/sample", root=SAMPLE, video_backend="pyav")
    shorter = delete_episodes(
        reference, [1], output_dir=tmp_path / "shorter", repo_id="local/shorter"
    )
    merge_datasets([reference, shorter], "local/both", output_dir=tmp_path / "both")
    with caplog.at_level(logging.WARNING, logger="mme_vla"):
        sources = [EpisodeSource(tmp_path / name) for name in ("shorter", "both")]
    expected = [EpisodeSource("sample").goal(e) for e in (0, 2, 3)]
    assert [sources[0].goal(e) for e in range(3)] == expected
    assert len(sources[1]) == 7 and [sources[1].goal(e) for e in (4, 5, 6)] == expected
    assert not [record for record in caplog.records if record.name.startswith("mme_vla")]
