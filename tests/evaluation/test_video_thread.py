"""Videos are compressed beside the simulation: the same video, and mistakes that are not lost."""

import threading
from pathlib import Path

import numpy as np
import pytest

from helpers.videos import video_bytes
from mme_vla.evaluation.rollout.video import EpisodeVideo
from mme_vla.utils.media import VideoWriter, video_frame

VIEWS = [[np.full((32, 48, 3), shade, np.uint8)] * 2 for shade in range(0, 240, 3)]


def video(folder: Path, keep: str = "all") -> EpisodeVideo:
    return EpisodeVideo(lambda outcome, goal: folder / f"{outcome}.mp4", keep)


def test_the_video_is_the_one_that_is_compressed_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads, add = [], VideoWriter.add

    def check_frame(writer: VideoWriter, image: np.ndarray) -> None:
        threads.append(threading.current_thread().name)
        add(writer, image)

    monkeypatch.setattr(VideoWriter, "add", check_frame)
    recorder = video(tmp_path)
    for views in VIEWS:
        recorder.add(views, "a goal", "step 3")
    path = recorder.finish("success", "")
    assert path == tmp_path / "success.mp4"
    assert len(threads) == len(VIEWS) and all(thread.startswith("video") for thread in threads)
    assert path.read_bytes() == video_bytes(video_frame(views, "a goal\nstep 3") for views in VIEWS)


def test_what_goes_wrong_beside_the_simulation_is_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(writer: VideoWriter, image: np.ndarray) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(VideoWriter, "add", full)
    recorder = video(tmp_path)
    recorder.add(VIEWS[0])
    with pytest.raises(OSError, match="no space"):
        recorder.finish("success", "")


def test_a_discarded_video_leaves_nothing(tmp_path: Path) -> None:
    recorder = video(tmp_path, "failure")
    for views in VIEWS:
        recorder.add(views)
    assert recorder.finish("success", "") is None
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("video")]
