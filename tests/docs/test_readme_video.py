"""The README's moving picture shows the front camera of an episode's video."""

from pathlib import Path

import numpy as np
import readme_video

from mme_vla.evaluation.rollout.video import EpisodeVideo
from mme_vla.utils.media import BORDER

GREEN, BLUE = (0, 200, 0), (0, 0, 200)
SIDE = readme_video.SIDE


def test_the_front_cameras_image_is_cut_out_and_the_conditioning_video_bordered(
    tmp_path: Path,
) -> None:
    path = tmp_path / "episode_success_go.mp4"
    video = EpisodeVideo(tmp_path, "episode")
    front, wrist = (np.full((SIDE, SIDE, 3), colour, np.uint8) for colour in (GREEN, BLUE))
    video.add([front, wrist], "go", demo=True)
    video.add([front, wrist], "go")
    assert video.finish("success", "go") == path
    images = readme_video.front_views(path)
    demonstrated, executed = (image.astype(int) for image in (images[0], images[1]))
    assert demonstrated.shape == executed.shape == (SIDE, SIDE, 3)
    assert np.abs(executed - GREEN).max() < 60, "no margin and no other camera"
    inner = demonstrated[BORDER:-BORDER, BORDER:-BORDER]
    assert np.abs(inner - GREEN).max() < 60
    assert (demonstrated[:BORDER] == (255, 0, 0)).all()
