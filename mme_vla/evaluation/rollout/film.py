"""An episode as a video: front and wrist side by side, the conditioning part in a red border, the subgoal below."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.files import draft_of

FPS = 30
BORDER = 10  # pixels
RED = (255, 0, 0)
CAPTION = 24  # pixels below the pictures
KEPT = ("none", "all", "success", "failure")
_LONGEST_GOAL = 100  # characters of a file name


class EpisodeVideo:
    """Draws and compresses frame by frame, so that no episode is held in memory.

    The file gets its name, which tells the outcome, when the episode is over; until then it is a hidden file beside it.

    Args:
        path: of the video, from outcome and goal.
        kept: which outcomes are kept: `all`, `success` or `failure`.
    """

    def __init__(self, path: Callable[[str, str], Path], kept: str = "all") -> None:
        self._path, self._kept = path, kept
        self._draft: Path | None = None
        self._container: Any = None
        self._stream: Any = None

    def add(self, front: np.ndarray, wrist: np.ndarray, caption: str | None = None, demo: bool = False) -> None:
        """Append two pictures [H, W, 3] uint8 of one moment."""
        import av

        picture = compose_frame(front, wrist, caption, demo)
        if self._container is None:
            self._open(picture)
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))

    def finish(self, outcome: str, goal: str) -> Path | None:
        """Close the video under its name; None if this outcome is not kept."""
        if self._draft is None or self._kept not in ("all", "success" if outcome == "success" else "failure"):
            self.discard()
            return None
        self._close(self._stream.encode(None))
        target = self._path(outcome, goal)
        self._draft.replace(target)
        self._draft = None
        return target

    def discard(self) -> None:
        """Drop what was drawn."""
        if self._draft is not None:
            self._close([])
            self._draft.unlink(missing_ok=True)
            self._draft = None

    def _open(self, picture: np.ndarray) -> None:
        import av

        folder = self._path("", "").parent
        folder.mkdir(parents=True, exist_ok=True)
        self._draft = draft_of(folder / f"film-{id(self):x}.mp4")
        self._container = av.open(str(self._draft), "w", format="mp4")
        self._stream = self._container.add_stream("libx264", rate=FPS)
        self._stream.height, self._stream.width = picture.shape[:2]
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "20", "preset": "veryfast", "threads": "1"}

    def _close(self, packets: list[Any]) -> None:
        self._container.mux(packets)
        self._container.close()
        self._container = self._stream = None


def compose_frame(front: np.ndarray, wrist: np.ndarray, caption: str | None, demo: bool) -> np.ndarray:
    """One picture [H + 24, 2 W, 3] uint8 of two [H, W, 3]; sides are made even, as the format wants them."""
    from PIL import Image, ImageDraw

    pictures = np.concatenate([front, wrist], axis=1)
    if demo:
        pictures = pictures.copy()
        for edge in (np.s_[:BORDER], np.s_[-BORDER:], np.s_[:, :BORDER], np.s_[:, -BORDER:]):
            pictures[edge] = RED
    height, width = pictures.shape[:2]
    canvas = np.zeros((height + height % 2 + CAPTION, width + width % 2, 3), np.uint8)
    canvas[:height, :width] = pictures
    if caption:
        image = Image.fromarray(canvas)
        ImageDraw.Draw(image).text((6, height + 6), caption, fill=(255, 255, 255))
        canvas = np.asarray(image)
    return canvas


def video_name(task: str, episode: int, outcome: str, goal: str) -> str:
    """`PickXtimes_ep3_success_pick_up_the_red_cube.mp4`."""
    words = re.sub(r"[^a-z0-9]+", "_", goal.lower()).strip("_")
    if len(words) > _LONGEST_GOAL:
        words = words[:_LONGEST_GOAL].rpartition("_")[0]
    return "_".join(part for part in (task, f"ep{episode}", outcome, words) if part) + ".mp4"
