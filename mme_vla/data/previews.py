"""An episode to look at: a film of both views, and a contact sheet with what is being done."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mme_vla.data.hdf5 import open_episode
from mme_vla.data.hdf5_episode import RawFrame
from mme_vla.data.hdf5_values import EpisodeRef
from mme_vla.files.media import RED, Tile, contact_sheet, film_frame, spread, write_film

if TYPE_CHECKING:
    from PIL.Image import Image

TILES, COLUMNS, SIDE = 12, 6, 192


def episode_sheet(frames: Sequence[RawFrame], title: str) -> "Image":
    """Front views spread evenly over an episode, each with its step and sub-task."""
    shown = [(step, frames[step]) for step in spread(len(frames), TILES)]
    tiles = [
        Tile(frame.front, f"{step} {frame.subgoals['simple_subgoal_online']}", RED if frame.is_demo else None)
        for step, frame in shown
    ]
    return contact_sheet(tiles, COLUMNS, title, side=SIDE)


def write_previews(file: Path, index: int, task: str, folder: Path) -> tuple[Path, Path]:
    """Write `<task>-<index>.png` and `.mp4` of a recorded episode; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet, film = (folder / f"{task}-{index:04d}.{end}" for end in ("png", "mp4"))
    with open_episode(EpisodeRef(file, index, task)) as episode:
        frames, goal = list(episode), episode.goals[0]
    episode_sheet(frames, f"{task} {index}: {goal}").save(sheet)
    pictures = (film_frame((f.front, f.wrist), f.subgoals["simple_subgoal_online"], f.is_demo) for f in frames)
    write_film(pictures, film)
    return sheet, film
