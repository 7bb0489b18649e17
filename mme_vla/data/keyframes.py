"""Keyframes of recorded episodes with depth and camera poses: a small store beside a dataset's tables.

Waypoint policies look at few frames: those before a planned motion begins, and every tenth one, from which a chain of
motions can be entered. So these alone are kept with what a cloud of points is made of, one `.npz` an episode.
"""

import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.hdf5_episode import RawEpisode
from mme_vla.data.waypoints import Motions, find_motions
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import CAMERAS
from mme_vla.errors import UserError
from mme_vla.files import require_file, write_atomically
from mme_vla.policy.sam2act.scene import Shot

FOLDER = "keyframes"
ENTRY_EVERY = 10
"""A chain of keyframes begins at every so manieth frame, as released."""
SIDE = 128
"""Pixels that pictures are kept at, as released."""
_ARRAYS = ("frames", "colours", "depth", "intrinsic", "extrinsic", "open", "decisions", "targets", "length")


def file_of(root: Path, episode: int) -> Path:
    """Where the keyframes of an episode of the dataset at `root` are."""
    return root / FOLDER / f"episode_{episode:06d}.npz"


def motions_of(episode: RawEpisode) -> Motions:
    """The planned motions of a whole episode: those of the video, then those of the execution."""
    rows = episode.pose_actions("waypoint_actions")
    parts = [(0, episode.exec_start), (episode.exec_start, episode.length)]
    found = [find_motions(rows[start:stop], start) for start, stop in parts if stop > start]
    return Motions(np.concatenate([part.decisions for part in found]), np.concatenate([part.targets for part in found]))


def write_keyframes(episode: RawEpisode, path: Path, side: int = SIDE) -> int:
    """Keep the keyframes of a recorded episode; returns how many frames those are.

    Raises:
        UserError: the recording has no depth, camera poses or waypoints.
    """
    motions = motions_of(episode)
    frames = np.union1d(np.arange(0, episode.length, ENTRY_EVERY), motions.decisions)
    arrays: dict[str, list[np.ndarray]] = {name: [] for name in ("colours", "depth", "intrinsic", "extrinsic")}
    for frame in frames:
        shots = [Shot(**episode.shot(int(frame), camera)).shrunk(side) for camera in CAMERAS]
        for name, kept in arrays.items():
            kept.append(np.stack([getattr(shot, name) for shot in shots]))
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez_compressed(
            file,
            frames=frames,
            colours=np.stack(arrays["colours"]),
            depth=np.stack(arrays["depth"]),
            intrinsic=arrays["intrinsic"][0],
            extrinsic=np.stack(arrays["extrinsic"]),
            open=np.array([episode.commanded_open(int(frame)) for frame in frames]),
            decisions=motions.decisions,
            targets=motions.targets,
            length=np.int64(episode.length),
        )
    return len(frames)


@dataclass(frozen=True)
class Link:
    """One keyframe of a chain.

    frame: what is seen. motion: which is to follow. place: keyframes since the chain was entered.
    """

    frame: int
    motion: int
    place: int


class EpisodeKeyframes:
    """The kept keyframes of one episode, read when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = require_file(path, "keyframes (written by `python -m mme_vla.data.convert keyframes=true`)")

    def _read(self, *names: str) -> dict[str, Any]:
        try:
            with np.load(self.path, allow_pickle=False) as file:
                missing = [name for name in _ARRAYS if name not in file]
                if missing:
                    raise UserError(f"{self.path} lacks {', '.join(missing)}: it holds no keyframes of this library.")
                return {name: file[name] for name in names}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
            raise UserError(f"{self.path} is damaged ({error}): convert the recordings again.") from None

    @cached_property
    def motions(self) -> Motions:
        """The episode's planned motions."""
        found = self._read("decisions", "targets")
        return Motions(found["decisions"], found["targets"])

    @cached_property
    def chains(self) -> list[list[Link]]:
        """All chains: from every tenth frame on, keyframe after keyframe to the last motion."""
        decisions, length = self.motions.decisions, int(self._read("length")["length"])
        chains = []
        for start in range(0, length, ENTRY_EVERY):
            first = max(int(np.searchsorted(decisions, start, side="right")) - 1, 0)
            seen = [start, *decisions[first + 1 :].tolist()]
            chains.append([Link(frame, first + place, place) for place, frame in enumerate(seen)])
        return chains

    def shots(self, frames: list[int]) -> list[list[Shot]]:
        """What the cameras saw at these frames, each of them a kept one."""
        found = self._read("frames", "colours", "depth", "intrinsic", "extrinsic")
        places = np.searchsorted(found["frames"], frames)
        return [
            [
                Shot(found["colours"][at, c], found["depth"][at, c], found["intrinsic"][c], found["extrinsic"][at, c])
                for c in range(found["colours"].shape[1])
            ]
            for at in places
        ]

    @cached_property
    def frames(self) -> np.ndarray:
        """The kept frames, int64 [n], ascending."""
        found: np.ndarray = self._read("frames")["frames"].astype(np.int64)
        return found

    def views(self, frames: np.ndarray, robot: Embodiment) -> dict[str, np.ndarray]:
        """Kept frames [n] as an environment delivers them to a robot that reads depth; see `KeyframeEpisode.observe`.

        Returns:
            Of every camera pictures [n, s, s, 3] uint8, depths [n, s, s, 1] float32 in millimetres, poses [n, 3, 4].
        """
        kept = self._read("frames", "colours", "depth", "extrinsic")
        at = np.searchsorted(kept["frames"], frames)
        found: dict[str, np.ndarray] = {}
        for camera in robot.cameras:
            c = CAMERAS.index(camera.name)
            beside = (kept["depth"][at, c][..., None].astype(np.float32), kept["extrinsic"][at, c].astype(np.float32))
            found |= {camera.name: kept["colours"][at, c], **dict(zip(camera.readings, beside, strict=False))}
        return found

    def commanded_open(self, frames: list[int]) -> np.ndarray:
        """Whether the gripper's command was to be open at these frames, [n] bool."""
        found = self._read("frames", "open")
        opened: np.ndarray = found["open"][np.searchsorted(found["frames"], frames)]
        return opened
