"""Datasets, caches and rows that are not what was written: reported, and before anything is trained
on them.
"""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers import artefacts
from mme_vla.data.cache import VisionCache, score_file, sum_file, token_file
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.errors import UserError
from mme_vla.utils import write_sums

FRAMES, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    shutil.copytree(SAMPLE, tmp_path / "copy")
    return tmp_path / "copy"


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def change(path: Path, name: str, edit: Callable[[list[Any]], list[Any]], kind: Any = None) -> None:
    table = pq.ParquetFile(path).read()
    values = edit(table[name].to_pylist())
    column = pa.array(values, kind or table[name].type)
    pq.write_table(table.set_column(table.column_names.index(name), name, column), path)


def at(row: int, value: Any) -> Callable[[list[Any]], list[Any]]:
    return lambda values: [*values[:row], value, *values[row + 1 :]]


def test_an_episode_without_a_cameras_video_is_named(copy: Path) -> None:
    name = "videos/wrist_image/from_timestamp"
    change(copy / EPISODES, name, at(2, None))
    with pytest.raises(UserError, match=f"empty cells in: {name} in row 2"):
        EpisodeSource(copy)


@pytest.mark.parametrize(
    ("file", "name", "edit", "kind", "message"),
    [
        (
            FRAMES,
            "actions",
            lambda rows: [row[:7] for row in rows],
            None,
            "cannot be read as tables of frames",
        ),
        (
            FRAMES,
            "actions",
            lambda rows: [str(row) for row in rows],
            pa.string(),
            "cannot be read as tables of frames",
        ),
        (FRAMES, "actions", at(300, None), None, "row 300 has actions None"),
        (
            FRAMES,
            "state",
            at(5, [float("nan")] * 8),
            None,
            "row 5 has state .*nan",
        ),  # of a conditioning video
        (
            FRAMES,
            "actions",
            at(900, [float("inf")] * 8),
            None,
            "row 900 has actions .*inf",
        ),  # held out
        (EPISODES, "dataset_to_index", at(3, 0), None, "dataset_to_index of episode 3 is 0"),
        (EPISODES, "dataset_to_index", at(1, 0), None, "dataset_from_index of episode 2 is"),
        (EPISODES, "dataset_to_index", at(3, 2**62), None, "dataset_to_index of episode 3"),
        (EPISODES, "dataset_from_index", at(2, 7), None, "dataset_from_index of episode 2 is 7"),
        (
            EPISODES,
            "tasks",
            at(2, ["something else"]),
            None,
            "task_index 2, 'pick up .*something else",
        ),
        (
            EPISODES,
            "tasks",
            lambda rows: [[3]] * len(rows),
            pa.list_(pa.int64()),
            "tasks of episode 0 is .*list of texts",
        ),
        (EPISODES, "episode_index", at(0, 9), None, "episode_index of episode 0 is 9"),
        (
            EPISODES,
            "videos/image/from_timestamp",
            at(0, float("nan")),
            None,
            "from_timestamp of episode 0 is nan",
        ),
        (EPISODES, "videos/image/chunk_index", at(0, -1), None, "chunk_index of episode 0 is -1"),
        (
            EPISODES,
            "videos/image/file_index",
            lambda rows: ["a"] * len(rows),
            pa.string(),
            "tables of episodes",
        ),
    ],
)
def test_damaged_tables_are_reported_on_opening(copy, file, name, edit, kind, message) -> None:
    change(copy / file, name, edit, kind)
    with pytest.raises(UserError, match=message):
        EpisodeSource(copy)


def test_what_stands_in_a_files_place_is_reported_without_waiting_and_without_the_hub(
    copy: Path,
) -> None:
    (copy / EPISODES).unlink()
    os.mkfifo(copy / EPISODES)
    with pytest.raises(UserError, match="is not a file"):
        EpisodeSource(copy)
    (copy / "meta" / "info.json").write_text('{"features":' * 100_000)
    with pytest.raises(UserError, match="nested too deeply"):
        EpisodeSource(copy)


@pytest.mark.parametrize(
    "template", ["../{video_key}.mp4", "{video_key.__class__}", "{chunk_index:99999999d}", 7]
)
def test_a_template_of_videos_stays_in_the_dataset(copy: Path, template: object) -> None:
    from mme_vla.data.video import video_file

    with pytest.raises(UserError, match=r"video_path|outside"):
        video_file(copy, template, "image", 0, 0)


def test_a_dataset_with_sums_is_checked_where_it_is_read_and_entirely_on_request(
    copy: Path,
) -> None:
    assert EpisodeSource(copy).verify() == 0  # without sums there is nothing to compare
    write_sums(copy)
    assert EpisodeSource(copy).verify() > 5
    flip(next(copy.glob("videos/image/**/*.mp4")))
    source = EpisodeSource(copy)  # videos are large: on request only
    with pytest.raises(UserError, match=r"file-000.mp4 is damaged"):
        source.verify()
    flip(copy / FRAMES)
    with pytest.raises(UserError, match=r"file-000.parquet is damaged"):
        EpisodeSource(copy)


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    artefacts.write_cache(tmp_path)
    return tmp_path / "cache"


def opened(folder: Path) -> VisionCache:
    source: Any = artefacts.SyntheticSource()
    return VisionCache(folder, source, artefacts.expected_fingerprint())


def test_a_flipped_bit_in_cached_tokens_is_detected_when_the_episode_is_first_read(
    cache: Path,
) -> None:
    path = token_file(cache, 1)
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    vision = opened(cache)
    vision.history(0)
    with pytest.raises(UserError, match=r"episode_000001.npy is damaged.*rebuild=true"):
        vision.history(1)


@pytest.mark.parametrize("what", ["empty", "another episode's", "scores alone"])
def test_sums_that_do_not_list_the_tokens_are_refused(cache: Path, what: str) -> None:
    lines = sum_file(cache, 1).read_text().splitlines(keepends=True)
    text = {
        "empty": "",
        "another episode's": sum_file(cache, 0).read_text(),
        "scores alone": "".join(line for line in lines if ".scores." in line),
    }[what]
    sum_file(cache, 1).write_text(text)
    with pytest.raises(UserError, match=r"episode_000001.sha256 is damaged: it does not list ep"):
        opened(cache).history(1)


def test_scores_out_of_order_are_refused(cache: Path) -> None:
    path = score_file(cache, 1)
    stored = dict(np.load(path))
    np.savez(path, frames=stored["frames"][::-1], values=stored["values"])
    sum_file(cache, 1).unlink()
    with pytest.raises(UserError, match="of ascending int64"):
        opened(cache).history(1)


def test_a_cache_without_sums_still_opens(cache: Path) -> None:
    before = opened(cache).history(0).gather(np.array([[1, 0]]))
    for episode in (0, 1):
        sum_file(cache, episode).unlink()
    assert opened(cache).history(0).gather(np.array([[1, 0]])).equal(before)


@pytest.mark.parametrize(
    "row",
    [
        '{"messages": [1, 2, 3]}',
        '{"messages": "abc"}',
        "[]",
        '{"messages": []}',
        "[" * 100_000,
        (
            '{"messages": [{"role": "system", "content": 1}, {"role": "user", "content": ""},'
            ' {"role": "assistant"}]}'
        ),
    ],
)
def test_rows_of_another_form_are_refused_by_line(tmp_path: Path, row: str) -> None:
    from mme_vla.subgoal.finetuning.rows import read_rows

    (tmp_path / "rows.jsonl").write_text(row + "\n")
    with pytest.raises(UserError, match=r"rows.jsonl, line 1"):
        read_rows(tmp_path / "rows.jsonl")


def test_an_image_of_the_rows_that_changed_is_detected(tmp_path: Path) -> None:
    artefacts.write_rows(tmp_path)
    flip(tmp_path / "a.mp4")
    with pytest.raises(UserError, match=r"a.mp4 is damaged"):
        artefacts.read_rows(tmp_path)
