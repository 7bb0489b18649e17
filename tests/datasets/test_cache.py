"""The vision cache: equal to the online history, resumable, and refused where it does not fit."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.h5_files import write_file
from helpers.memory_fakes import WIDTH, LastFrames, encode
from mme_vla.data import cache_building as cache_build
from mme_vla.data.cache import (
    FINGERPRINT,
    CacheMissingError,
    VisionCache,
    cache_folder,
    fingerprint,
    score_file,
    token_file,
)
from mme_vla.data.cache_building import build_cache, clear_cache, ensure_cache, estimate
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.errors import UserError
from mme_vla.memory.history import OnlineHistory
from mme_vla.types import FrameBatch

COMMAND = "mme-vla cache model=mine data=here"


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> EpisodeSource:
    folder = tmp_path_factory.mktemp("cache")
    write_file(folder / "record_dataset_Alpha.h5", [30, 17, 8], videos=[6, 0, 2])
    convert(list_episodes(find_files([folder])), folder / "out", ConvertOptions(images="png"))
    return EpisodeSource(folder / "out")


def ensure(source: EpisodeSource, memory: LastFrames, root: Path, **options) -> VisionCache:
    options = {"dtype": "float32", "batch_size": 3, "command": COMMAND, **options}
    return ensure_cache(source, memory, encode, options.pop("encoder", "abc"), root=root, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keep_every", "scored", "dtype"),
    [(1, False, "float32"), (1, True, "float32"), (4, False, "bfloat16"), (4, True, "bfloat16")],
)
def test_cached_and_online_histories_are_the_same(
    source, tmp_path, keep_every, scored, dtype
) -> None:
    # in batches of other sizes MKL may add in another order
    tolerance = 1e-6 if dtype == "float32" else 0
    memory = LastFrames(keep_every=keep_every, scored=scored)
    cache = ensure(source, memory, tmp_path, dtype=dtype)
    assert cache.width == WIDTH
    for episode in range(3):
        history = cache.history(episode)
        online = OnlineHistory(
            memory.storage, memory.make_scorer(), int(source.exec_starts[episode])
        )
        for t in range(int(source.lengths[episode])):
            frame = source.frames(episode, [t])
            expected = frame[online.to_encode(1)]
            tokens = encode(expected) if len(expected) else torch.zeros(0, 4, WIDTH)
            if dtype == "bfloat16":
                tokens = tokens.to(torch.bfloat16)
            online.take(FrameBatch.of(frame), lambda _, made=tokens: made)
            cached, streamed = (
                memory.gather_selection(history, t),
                memory.gather_selection(online, t),
            )
            for one, other in zip(cached.tensors(), streamed.tensors(), strict=True):
                torch.testing.assert_close(one, other, rtol=0, atol=tolerance)
        assert (len(history), history.exec_start) == (len(online), online.exec_start)


def test_an_interrupted_build_continues_with_the_missing_episodes(source, tmp_path) -> None:
    memory, calls = LastFrames(), []

    def killed(frames: np.ndarray) -> torch.Tensor:
        calls.append(len(frames))
        if len(calls) == 12:  # within the second episode
            raise KeyboardInterrupt
        return encode(frames)

    expected = fingerprint(source, memory.storage, "abc", "float32")
    folder = cache_folder(tmp_path, source, expected)
    with pytest.raises(KeyboardInterrupt):
        build_cache(source, memory, killed, folder, expected, batch_size=3)
    with pytest.raises(
        CacheMissingError,
        match=rf"half-written: 2 of 3 episodes are missing. Finish it with: {COMMAND}$",
    ):
        VisionCache(folder, source, expected, COMMAND)
    first = token_file(folder, 0).stat().st_mtime_ns
    assert build_cache(source, memory, encode, folder, expected, batch_size=3) == 2
    assert token_file(folder, 0).stat().st_mtime_ns == first
    straight = ensure(source, memory, tmp_path / "whole")
    resumed = VisionCache(folder, source, expected)
    for episode in range(3):
        assert np.array_equal(
            np.load(token_file(straight.folder, episode)), np.load(token_file(folder, episode))
        )
    assert resumed.width == straight.width


def test_processes_share_the_episodes(source, tmp_path, monkeypatch) -> None:
    memory = LastFrames()
    expected = fingerprint(source, memory.storage, "abc", "float32")
    folder = cache_folder(tmp_path, source, expected)
    monkeypatch.setenv("WORLD_SIZE", "2")
    episodes = []
    for rank in ("1", "0"):
        monkeypatch.setenv("RANK", rank)
        episodes.append(build_cache(source, memory, encode, folder, expected))
    assert episodes == [1, 2]
    VisionCache(folder, source, expected)


def test_training_builds_small_caches_and_names_the_command_for_large_ones(
    source, tmp_path
) -> None:
    with pytest.raises(
        UserError,
        match=rf"There is no vision cache at .* {COMMAND} .*55 frames.*max_build_frames=54",
    ):
        ensure(source, LastFrames(), tmp_path, max_build_frames=54)
    assert not any(tmp_path.iterdir())
    ensure(source, LastFrames(), tmp_path, max_build_frames=55)
    ensure(source, LastFrames(), tmp_path, max_build_frames=0)  # it is there now


def test_other_encoders_poolings_and_data_have_other_folders(source, tmp_path) -> None:
    folders = {
        ensure(source, LastFrames(), tmp_path).folder,
        ensure(source, LastFrames(), tmp_path, encoder="other").folder,
        ensure(source, LastFrames(keep_every=4), tmp_path).folder,
        ensure(source, LastFrames(scored=True), tmp_path).folder,
        ensure(source, LastFrames(), tmp_path, dtype="bfloat16").folder,
    }
    assert len(folders) == 5


def test_a_stale_cache_is_refused_with_the_command_that_mends_it(source, tmp_path) -> None:
    cache = ensure(source, LastFrames(), tmp_path)
    content = json.loads((cache.folder / FINGERPRINT).read_text())
    (cache.folder / FINGERPRINT).write_text(json.dumps({**content, "encoder": "another"}))
    with pytest.raises(
        UserError, match=rf"stale: encoder is 'another', expected 'abc'. .*{COMMAND} rebuild=true"
    ):
        ensure(source, LastFrames(), tmp_path)
    assert token_file(cache.folder, 0).exists()


def reshape(path: Path) -> None:
    np.save(path, np.load(path)[:-1])


def keep(count: int):
    """Cut a file to its first bytes."""
    return lambda path: path.write_bytes(path.read_bytes()[:count])


def flip(path: Path) -> None:
    path.write_bytes(
        b"".join(bytes([byte ^ 0xFF]) for byte in path.read_bytes()[:64]) + path.read_bytes()[64:]
    )


@pytest.mark.parametrize(
    ("file", "damage"),
    [*((token_file, damage) for damage in (keep(-100), keep(40), keep(0), flip, reshape)),
     *((score_file, damage) for damage in (keep(-30), keep(10), keep(0), flip))],
)  # fmt: skip
def test_a_damaged_file_is_refused(source, tmp_path, file, damage) -> None:
    memory = LastFrames(scored=file is score_file)
    path = file(ensure(source, memory, tmp_path).folder, 1)
    damage(path)
    with pytest.raises(UserError, match=rf"{path.name} .*{COMMAND} rebuild=true"):
        ensure(source, memory, tmp_path).history(1)


def test_foreign_folders_are_neither_read_nor_cleared(source, tmp_path) -> None:
    memory = LastFrames()
    folder = cache_folder(tmp_path, source, fingerprint(source, memory.storage, "abc", "float32"))
    folder.mkdir(parents=True)
    (folder / "thesis.txt").write_text("years of work")
    with pytest.raises(UserError, match="it is not a vision cache"):
        ensure(source, memory, tmp_path)
    with pytest.raises(UserError, match="nothing is removed"):
        clear_cache(folder)


def test_an_estimate_counts_frames_and_bytes_and_saves_nothing(source, tmp_path) -> None:
    frames, n_bytes, seconds = estimate(source, LastFrames(keep_every=4), encode, "bfloat16")
    n_frames = 8 + 5 + 3  # frame 0 and 3, 7, … of 30, 17 and 8
    assert (frames, n_bytes) == (n_frames, n_frames * 4 * WIDTH * 2) and seconds > 0


def test_an_encoder_of_another_grid_is_noticed(source, tmp_path) -> None:
    with pytest.raises(ValueError, match="encode"):
        ensure_cache(
            source, LastFrames(), lambda frames: encode(frames, grid=4), "abc", root=tmp_path
        )
    assert cache_build.process_rank() == (0, 1)
