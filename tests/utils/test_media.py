"""Videos, contact sheets and the border of conditioning videos."""

from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import torch

from helpers.videos import video_bytes
from mme_vla.embodiment import ROBOMME_JOINT, Camera
from mme_vla.evaluation.rollout.environment import ChunkCommand, ChunkEnv
from mme_vla.evaluation.rollout.video import EpisodeVideo
from mme_vla.utils.media import (
    BORDER,
    CAPTION,
    RED,
    Tile,
    contact_sheet,
    video_frame,
    write_video,
)
from mme_vla.utils.style import rgb

GREEN, BLUE, YELLOW = ((0, 200, 0), (0, 0, 200), (200, 200, 0))
NOISE = np.random.default_rng(0).integers(0, 256, (4, 33, 45, 3), dtype=np.uint8)


def baseline(colour: tuple[int, int, int], height: int = 64, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


def decoded(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(video=0)]


class ThreeCameras:
    """An environment that shows one frame of three cameras, and succeeds at once."""

    def _observation(self, count: int) -> dict[str, list[np.ndarray]]:
        views = {"front": baseline(GREEN), "wrist": baseline(BLUE), "side": baseline(YELLOW, 48)}
        joints = {
            "joint_state_list": [np.zeros(7)] * count,
            "gripper_state_list": [np.zeros(2)] * count,
        }
        return joints | {f"{name}_rgb_list": [view] * count for name, view in views.items()}

    def reset(self) -> tuple:
        return self._observation(2), {"status": "ongoing", "task_goal": ["go"]}

    def step(self, action: np.ndarray) -> tuple:
        return self._observation(1), 0.0, True, False, {"status": "success"}

    def close(self) -> None: ...


@pytest.mark.parametrize("names", [("side", "front", "wrist"), ("side", "wrist")])
def test_an_episodes_video_shows_every_camera_of_the_robot(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    robot = replace(ROBOMME_JOINT, cameras=tuple(map(Camera, names)), memory_camera="side")
    env = ChunkEnv(ThreeCameras, video=EpisodeVideo(tmp_path, "a"), robot=robot)
    env.reset()
    env.step(ChunkCommand(np.zeros((1, 8), np.float32)))
    env.close()
    frames = decoded(tmp_path / "a_success_go.mp4")
    side = 2 * BORDER
    assert len(frames) == 3 and frames[0].shape == (64 + side + 2 * CAPTION, 3 * 64 + side, 3)
    inside = [frames[2][BORDER + 24, BORDER + 64 * view + 32] for view in range(3)]
    order = [
        *names,
        *(name for name in ("front", "wrist") if name not in names),
    ]  # the benchmark's own come last
    for colour, name in zip(inside, order, strict=True):
        assert np.abs(colour - {"front": GREEN, "wrist": BLUE, "side": YELLOW}[name]).max() < 25, (
            name
        )
    assert frames[2][BORDER + 56, BORDER + 32].max() < 25, (
        "a lower image stands on the upper edge, on black"
    )


def test_the_border_lies_around_all_views_and_covers_none_of_their_pixels() -> None:
    views = [baseline(GREEN), baseline(BLUE, 63, 33)]
    framed, bare = (video_frame(views, video=video) for video in (True, False))
    assert framed.shape == bare.shape == (64 + 2 * BORDER, 98 + 2 * BORDER, 3), "sides are even"
    changed = (framed != bare).any(-1)
    assert changed[:BORDER].all() and changed[:, :BORDER].all()
    assert changed[-BORDER:].all() and changed[:, -BORDER:].all()
    assert (framed[changed] == RED).all()
    for image in (framed, bare):
        inside = image[BORDER:-BORDER, BORDER:-BORDER]
        assert (inside[:, :64] == views[0]).all() and (inside[:63, 64:97] == views[1]).all()


def test_a_caption_that_is_too_long_ends_within_the_image() -> None:
    captioned = video_frame(
        [baseline(GREEN)], "pick up the red cube and place it on the target " * 5
    )
    below = captioned[64 + 2 * BORDER :]
    assert below[:, :58].max() > 200 and below[:, -4:].max() == 0


def test_a_band_has_a_line_for_the_goal_and_one_for_the_step_or_is_not_there() -> None:
    assert video_frame([baseline(GREEN)]).shape[0] == 64 + 2 * BORDER
    lines = video_frame([baseline(GREEN, width=256)], "pick up the cube\nstep 12 · success")
    goal, step = np.split(lines[64 + 2 * BORDER :], 2)
    assert len(goal) == len(step) == CAPTION and goal.max() > 200 and step.max() > 200


def test_a_video_has_its_name_only_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "a.mp4"

    def frames():
        yield baseline(GREEN)
        assert not path.exists()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(frames(), path)
    assert list(path.parent.iterdir()) == []
    assert write_video([baseline(GREEN)] * 3, path) == len(decoded(path)) == 3
    with pytest.raises(ValueError, match="at least one frame"):
        write_video([], path)
    assert len(decoded(path)) == 3, "the old video stays"


def test_equal_frames_make_equal_bytes_whatever_a_variable_hides_from_pytorch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    # the encoder's memory is not always clean
    ballast = [np.ones(size, np.uint8) for size in range(1000, 200_000, 5000)]
    assert len({video_bytes(NOISE) for _ in range(40) if ballast.pop() is not None}) == 1


def test_odd_sides_survive(tmp_path: Path) -> None:
    assert len(video_bytes(NOISE, crf=10)) > len(video_bytes(NOISE, crf=30))
    (tmp_path / "odd.mp4").write_bytes(video_bytes(NOISE))
    assert [frame.shape for frame in decoded(tmp_path / "odd.mp4")] == [(33, 45, 3)] * 4


def test_a_contact_sheet_holds_every_tile_and_outlines_the_highlighted_ones() -> None:
    tiles = [
        Tile(baseline(GREEN), "one"),
        Tile(baseline(BLUE), "two", RED),
        Tile(baseline(YELLOW), "three"),
    ]
    sheet = np.asarray(contact_sheet(tiles, columns=2, title="all"))
    for tile in tiles:
        assert (sheet == tile.image[0, 0]).all(-1).sum() > 150**2, tile.label
    assert 0 < (sheet == RED).all(-1).sum() < 4 * 2 * 170


def test_a_contact_sheet_has_a_dark_ground_and_letters_that_can_be_read_on_it() -> None:
    sheet = np.asarray(contact_sheet([Tile(baseline(GREEN), "one")], columns=1, title="all"))
    assert tuple(sheet[0, 0]) == rgb("card", dark=True)
    title = sheet[:40].reshape(-1, 3)
    assert title.max() > 200 and (title.max(1) < 64).mean() > 0.8
