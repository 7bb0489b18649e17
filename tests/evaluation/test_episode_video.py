"""Videos of episodes, compressed frame by frame."""

from pathlib import Path

import numpy as np
import pytest

from helpers.videos import video_bytes
from mme_vla.evaluation.rollout.video import EpisodeVideo
from mme_vla.utils.media import VideoWriter, video_frame

VIEWS = [[np.full((32, 48, 3), shade, np.uint8)] * 2 for shade in range(0, 240, 3)]


def video(folder: Path, keep: str = "all") -> EpisodeVideo:
    return EpisodeVideo(folder, "StopCube_ep3", keep)


def test_frames_have_goal_and_caption_and_the_file_its_outcome(tmp_path: Path) -> None:
    recorder = video(tmp_path)
    for views in VIEWS:
        recorder.add(views, "a goal", "step 3")
    path = recorder.finish("success", "press: the button!")
    assert path == tmp_path / "StopCube_ep3_success_press_the_button.mp4"
    assert path.read_bytes() == video_bytes(video_frame(views, "a goal\nstep 3") for views in VIEWS)


def test_a_full_disk_is_reported_and_what_was_written_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(writer: VideoWriter, image: np.ndarray) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(VideoWriter, "add", full)
    recorder = video(tmp_path)
    with pytest.raises(OSError, match="no space"):
        recorder.add(VIEWS[0])
    recorder.discard()
    assert not list(tmp_path.iterdir())


def test_a_discarded_video_leaves_nothing(tmp_path: Path) -> None:
    recorder = video(tmp_path, "failure")
    for views in VIEWS:
        recorder.add(views)
    assert recorder.finish("success", "") is None
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
