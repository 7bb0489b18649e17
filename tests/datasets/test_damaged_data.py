"""Datasets, caches and rows that are not what was written: reported, and before anything is trained on them."""

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
from mme_vla.data.cache import VisionCache, sum_file, token_file
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


@pytest.mark.parametrize(
    ("name", "edit", "kind", "said"),
    [
        ("actions", lambda rows: [row[:7] for row in rows], None, "cannot be read as tables of frames"),
        ("actions", lambda rows: [str(row) for row in rows], pa.string(), "the column actions is string"),
        ("actions", at(300, None), None, "row 300 has actions None"),
        ("state", at(5, [float("nan")] * 8), None, "row 5 has state .*nan"),  # of a conditioning video
        ("actions", at(900, [float("inf")] * 8), None, "row 900 has actions .*inf"),  # of the held-out episode
    ],
    ids=["seven", "text", "null", "nan", "infinite"],
)
def test_rows_that_are_not_eight_finite_numbers_are_refused_on_opening(copy, name, edit, kind, said) -> None:
    change(copy / FRAMES, name, edit, kind)
    with pytest.raises(UserError, match=said):
        EpisodeSource(copy)


@pytest.mark.parametrize(
    ("name", "edit", "said"),
    [
        ("dataset_to_index", at(1, 0), "episode 1 reaches from row 173 to row 0"),
        ("dataset_to_index", at(3, 2**62), "episode 3 reaches"),
        ("dataset_from_index", at(2, 7), "back to back|reaches"),
        ("tasks", at(2, []), "episode 2 has no task in words"),
        ("episode_index", at(0, 9), "does not number its episodes"),
        ("videos/image/from_timestamp", at(0, float("nan")), "no number of seconds"),
    ],
    ids=["negative", "endless", "gap", "no task", "number", "time"],
)
def test_impossible_episodes_are_refused_on_opening(copy, name, edit, said) -> None:
    change(copy / EPISODES, name, edit)
    with pytest.raises(UserError, match=said):
        EpisodeSource(copy)


def test_no_table_of_episodes_may_be_empty(copy: Path) -> None:
    pq.write_table(pq.ParquetFile(copy / EPISODES).read().slice(0, 0), copy / EPISODES)
    with pytest.raises(UserError, match="it describes 0"):
        EpisodeSource(copy)


def test_what_stands_in_a_files_place_is_said_without_waiting_and_without_the_hub(copy: Path) -> None:
    (copy / EPISODES).unlink()
    os.mkfifo(copy / EPISODES)
    with pytest.raises(UserError, match="is not a file"):
        EpisodeSource(copy)
    (copy / "meta" / "info.json").write_text('{"features":' * 100_000)
    with pytest.raises(UserError, match="nested too deeply"):
        EpisodeSource(copy)


@pytest.mark.parametrize("template", ["../{video_key}.mp4", "{video_key.__class__}", "{chunk_index:99999999d}", 7])
def test_a_template_of_videos_stays_in_the_dataset(copy: Path, template: object) -> None:
    from mme_vla.data.tables import video_file

    with pytest.raises(UserError, match=r"video_path|outside"):
        video_file(copy, template, "image", 0, 0)


def test_a_dataset_with_sums_is_checked_where_it_is_read_and_whole_on_request(copy: Path) -> None:
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


def test_a_flipped_bit_in_cached_tokens_is_found_when_the_episode_is_first_read(cache: Path) -> None:
    path = token_file(cache, 1)
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    vision = opened(cache)
    vision.history(0)
    with pytest.raises(UserError, match=r"episode_000001.npy is damaged.*rebuild=true"):
        vision.history(1)


def test_each_process_compares_an_episode_once(cache: Path, monkeypatch) -> None:
    from mme_vla.utils import checksums

    asked: list[Path] = []
    real = checksums.file_sum
    monkeypatch.setattr(checksums, "file_sum", lambda path: asked.append(path) or real(path))
    vision = opened(cache)
    vision.max_open = 1
    for episode in (0, 1, 0, 1):
        vision.history(episode)
    assert len(asked) == 4  # tokens and scores of two episodes


def test_a_cache_without_sums_still_opens(cache: Path) -> None:
    before = opened(cache).history(0).gather(np.array([[1, 0]]))
    for episode in (0, 1):
        sum_file(cache, episode).unlink()
    assert opened(cache).history(0).gather(np.array([[1, 0]])).equal(before)


@pytest.mark.parametrize(
    "row",
    [
        '{"messages": [1, 2, 3]}', '{"messages": "abc"}', "[]", '{"messages": []}', "[" * 100_000,
        '{"messages": [{"role": "system", "content": 1}, {"role": "user", "content": ""}, {"role": "assistant"}]}',
    ],
)  # fmt: skip
def test_rows_of_another_form_are_refused_by_line(tmp_path: Path, row: str) -> None:
    from mme_vla.subgoal.finetuning.rows import read_rows

    (tmp_path / "rows.jsonl").write_text(row + "\n")
    with pytest.raises(UserError, match=r"rows.jsonl, line 1"):
        read_rows(tmp_path / "rows.jsonl")


def test_a_picture_of_the_rows_that_changed_is_found(tmp_path: Path) -> None:
    artefacts.write_rows(tmp_path)
    flip(tmp_path / "a.mp4")
    with pytest.raises(UserError, match=r"a.mp4 is damaged"):
        artefacts.read_rows(tmp_path)
