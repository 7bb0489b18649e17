"""Videos are compressed beside the simulation: the same video, and mistakes that are not lost."""

import threading
from pathlib import Path

import numpy as np
import pytest

from mme_vla.evaluation.rollout.video import BEHIND, EpisodeVideo
from mme_vla.utils.media import VideoWriter, video_bytes, video_frame

VIEWS = [[np.full((32, 48, 3), shade, np.uint8)] * 2 for shade in range(0, 240, 3)]


def video(folder: Path, kept: str = "all") -> EpisodeVideo:
    return EpisodeVideo(lambda outcome, goal: folder / f"{outcome}.mp4", kept)


def test_the_film_is_the_one_that_is_compressed_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    threads, add = [], VideoWriter.add

    def seen(film: VideoWriter, picture: np.ndarray) -> None:
        threads.append(threading.current_thread().name)
        add(film, picture)

    monkeypatch.setattr(VideoWriter, "add", seen)
    drawn = video(tmp_path)
    for views in VIEWS:
        drawn.add(views, "a caption")
    path = drawn.finish("success", "")
    assert path == tmp_path / "success.mp4"
    assert len(threads) == len(VIEWS) and all(thread.startswith("film") for thread in threads)
    assert path.read_bytes() == video_bytes(video_frame(views, "a caption") for views in VIEWS)


def test_a_slow_film_is_waited_for_only_when_it_falls_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, add = threading.Event(), VideoWriter.add

    def slow(film: VideoWriter, picture: np.ndarray) -> None:
        assert gate.wait(10)
        add(film, picture)

    monkeypatch.setattr(VideoWriter, "add", slow)
    drawn = video(tmp_path)
    for _ in range(BEHIND):
        drawn.add(VIEWS[0])  # none is compressed yet
    gate.set()
    assert drawn.finish("fail", "") is not None


def test_what_goes_wrong_beside_the_simulation_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(film: VideoWriter, picture: np.ndarray) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(VideoWriter, "add", full)
    drawn = video(tmp_path)
    drawn.add(VIEWS[0])
    with pytest.raises(OSError, match="no space"):
        drawn.finish("success", "")


def test_a_film_that_is_not_kept_leaves_nothing(tmp_path: Path) -> None:
    drawn = video(tmp_path, "failure")
    for views in VIEWS:
        drawn.add(views)
    assert drawn.finish("success", "") is None
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("film")]
