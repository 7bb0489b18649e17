"""Keyframes of recorded episodes with depth and camera poses: a small store beside a dataset's
tables.

Waypoint policies look at few frames: those before a planned motion begins, and every tenth one,
from which a chain of motions can be entered. So these alone are kept with what a cloud of points is
made of, one `.npz` an episode.
"""

import zipfile
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.data import Dataset

from mme_vla.data.cache import VisionCache
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import RawEpisode
from mme_vla.data.waypoints import Motions, find_motions
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import CAMERAS
from mme_vla.errors import UserError, require
from mme_vla.extras.methods.sam2act.processor import Shot
from mme_vla.memory.perturbation import Perturbation
from mme_vla.policy.base import Policy
from mme_vla.processing.base import PolicyProcessor
from mme_vla.registry import SIDE_FILES, TRAINING_SETS
from mme_vla.utils import require_file, write_atomically

FOLDER = "keyframes"
ENTRY_EVERY = 10
"""A chain of keyframes begins at every so manieth frame, as released."""
SIDE = 128
"""Pixels that images are kept at, as released."""
_ARRAYS = (
    "frames",
    "colours",
    "depth",
    "intrinsic",
    "extrinsic",
    "open",
    "decisions",
    "targets",
    "length",
)


def motions_of(episode: RawEpisode) -> Motions:
    """The planned motions of a whole episode: those of the video, then those of the execution."""
    rows = episode.pose_actions("waypoint_actions")
    decisions, targets = [], []
    for start, stop in ((0, episode.exec_start), (episode.exec_start, episode.length)):
        if stop > start:
            motions = find_motions(rows[start:stop], start)
            decisions.append(motions.decisions)
            targets.append(motions.targets)
    return Motions(np.concatenate(decisions), np.concatenate(targets))


@SIDE_FILES.register("keyframes")
class KeyframeFile:
    """The keyframes of a recording, kept by `mme-vla convert keyframes=true`."""

    @staticmethod
    def file_of(root: Path, episode: int) -> Path:
        """Where the keyframes of an episode of the dataset at `root` are."""
        return root / FOLDER / f"episode_{episode:06d}.npz"

    @staticmethod
    def write(episode: RawEpisode, path: Path, side: int = SIDE) -> int:
        """Keep the keyframes of a recorded episode; returns how many frames those are."""
        motions = motions_of(episode)
        frames = np.union1d(np.arange(0, episode.length, ENTRY_EVERY), motions.decisions)
        arrays: dict[str, list[np.ndarray]] = defaultdict(list)
        for frame in frames:
            shots = [Shot(**episode.shot(int(frame), camera)).shrunk(side) for camera in CAMERAS]
            for name in ("colours", "depth", "intrinsic", "extrinsic"):
                arrays[name].append(np.stack([getattr(shot, name) for shot in shots]))
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

    frame: what is seen.
    motion: which is to follow.
    place: keyframes since the chain was entered.
    """

    frame: int
    motion: int
    place: int


class EpisodeKeyframes:
    """The kept keyframes of one episode, read when they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = require_file(path, "keyframes (written by `mme-vla convert keyframes=true`)")

    def _read(self, *names: str) -> dict[str, Any]:
        try:
            with np.load(self.path, allow_pickle=False) as file:
                missing = [name for name in _ARRAYS if name not in file]
                if missing:
                    raise UserError(
                        f"{self.path} lacks {', '.join(missing)}: it holds no keyframes of this"
                        " library."
                    )
                return {name: file[name] for name in names}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
            raise UserError(
                f"{self.path} is damaged ({error}): convert the recordings again."
            ) from None

    def check(self, length: int) -> None:
        """Refuse keyframes that are not those of an episode of `length` frames."""
        arrays = self._read("frames", "decisions", "targets", "open", "length")
        decisions, targets = arrays["decisions"], arrays["targets"]
        expected = np.union1d(np.arange(0, length, ENTRY_EVERY), decisions)
        fits = (
            arrays["length"] == length
            and np.array_equal(arrays["frames"], expected)
            and expected[-1] < length
            and len(arrays["open"]) == len(expected)
            and len(targets) == len(decisions)
            and np.isfinite(targets).all()
        )
        if not fits:
            raise UserError(
                f"{self.path} holds {len(arrays['frames'])} keyframes of an episode of"
                f" {arrays['length']} frames, with {len(decisions)} motions; expected those of the"
                f" dataset's episode of {length} frames. Convert the recordings again with"
                " keyframes=true."
            )

    @cached_property
    def motions(self) -> Motions:
        arrays = self._read("decisions", "targets")
        return Motions(arrays["decisions"], arrays["targets"])

    @cached_property
    def chains(self) -> list[list[Link]]:
        """All chains: from every tenth frame on, keyframe after keyframe to the last motion."""
        decisions, length = self.motions.decisions, int(self._read("length")["length"])
        chains = []
        for start in range(0, length, ENTRY_EVERY):
            first = max(int(np.searchsorted(decisions, start, side="right")) - 1, 0)
            visited = [start, *decisions[first + 1 :].tolist()]
            chain = [Link(frame, first + place, place) for place, frame in enumerate(visited)]
            chains.append(chain)
        return chains

    def shots(self, frames: list[int]) -> list[list[Shot]]:
        """What the cameras saw at these frames, each of them a kept one."""
        arrays = self._read("frames", "colours", "depth", "intrinsic", "extrinsic")
        places = np.searchsorted(arrays["frames"], frames)
        shots = []
        for at in places:
            by_camera = zip(
                arrays["colours"][at],
                arrays["depth"][at],
                arrays["intrinsic"],
                arrays["extrinsic"][at],
                strict=True,
            )
            shots.append([Shot(*parts) for parts in by_camera])
        return shots

    @cached_property
    def frames(self) -> np.ndarray:
        """The kept frames, int64 [n], ascending."""
        frames: np.ndarray = self._read("frames")["frames"].astype(np.int64)
        return frames

    def views(self, frames: np.ndarray, robot: Embodiment) -> dict[str, np.ndarray]:
        """Kept frames [n] as an environment delivers them to a robot that reads depth; see
        `KeyframeEpisode.observe`.

        Returns:
            Of every camera images [n, s, s, 3] uint8, depths [n, s, s, 1] float32 in millimetres,
            poses [n, 3, 4].
        """
        arrays = self._read("frames", "colours", "depth", "extrinsic")
        at = np.searchsorted(arrays["frames"], frames)
        readings: dict[str, np.ndarray] = {}
        for camera in robot.cameras:
            c = CAMERAS.index(camera.name)
            readings[camera.name] = arrays["colours"][at, c]
            if camera.depth:
                depth, pose = camera.readings
                readings[depth] = arrays["depth"][at, c][..., None].astype(np.float32)
                readings[pose] = arrays["extrinsic"][at, c].astype(np.float32)
        return readings

    def commanded_open(self, frames: list[int]) -> np.ndarray:
        """Whether the gripper's command was to be open at these frames, [n] bool."""
        arrays = self._read("frames", "open")
        opened: np.ndarray = arrays["open"][np.searchsorted(arrays["frames"], frames)]
        return opened


@dataclass(frozen=True)
class KeyframeSample:
    """A run of k keyframes as they are kept, before any processing.

    goal: in words.
    shots: k times the shots of all cameras.
    open: [k] whether the gripper's command was to be open.
    places: [k] keyframes since the chain was entered.
    targets: [k, 7] the motions that follow.
    """

    goal: str
    shots: list[list[Shot]]
    open: np.ndarray
    places: np.ndarray
    targets: np.ndarray


class KeyframeDataset(Dataset[dict[str, Any]]):
    """Runs of keyframes from the chains of several datasets' episodes.

    There are as many samples to an epoch as places to begin at: with `length` 1 one for every
    transition of every chain, else one for every chain that is long enough. What is sampled is fair
    to tasks, as released: with `length` 1 a task, then one of its transitions; else a task, one of
    its episodes and a chain of that, sampled again where the chain is too short, and a window of
    it. Held-out samples are gone through one by one.
    """

    def __init__(
        self,
        sources: Sequence[EpisodeSource],
        processor: PolicyProcessor,
        length: int,
        *,
        episodes: Sequence[np.ndarray] | None = None,
        seed: int = 42,
        sampled: bool = True,
    ) -> None:
        """Find the chains; images are not read yet.

        Args:
            length: k; keyframes of a sample.
            episodes: which of each source's episodes to use; None uses all.
            sampled: whether a sample is sampled anew each epoch; else it is the place of its
                number.
        """
        self.sources = list(sources)
        self.processor = processor
        self.length = length
        self.seed = seed
        self.epoch = 0
        self.sampled = sampled
        self.total_frames = 0
        if episodes is None:
            episodes = [np.arange(len(source)) for source in sources]
        self._items: list[tuple[int, int, EpisodeKeyframes, list[Link]]] = []
        # how often an item is sampled within its task, relative to the task's others
        shares: list[float] = []
        tasks: list[str] = []
        counted: Counter[str] = Counter()
        longest = 0
        for number, (source, part) in enumerate(zip(sources, episodes, strict=True)):
            for episode in map(int, part):
                # a sample has one: an episode of several is refused here, not while training
                source.goal(episode)
                self.total_frames += int(source.lengths[episode])
                keyframes = EpisodeKeyframes(KeyframeFile.file_of(source.root, episode))
                keyframes.check(int(source.lengths[episode]))
                chains = [chain for chain in keyframes.chains if len(chain) >= length]
                longest = max(longest, *map(len, keyframes.chains))
                runs = chains
                share = 1 / len(keyframes.chains)
                if length == 1:  # every keyframe is a sample
                    runs = [[link] for chain in chains for link in chain]
                    share = 1.0
                # An episode too short for any run still takes its turn, and the draw is repeated
                # for all tasks alike.
                task = source.task(episode)
                counted[task] += 1
                for run in runs:
                    self._items.append((number, episode, keyframes, run))
                    shares.append(share)
                    tasks.append(task)
        require(
            self._items,
            f"No chain of keyframes in the data has {length} of them; the longest has {longest}."
            " Train on longer tasks, or remember fewer (backbone.remembered).",
        )
        if length == 1:
            counted = Counter(tasks)
        chances = np.array(shares) / [counted[task] for task in tasks]
        self._sample_thresholds = np.cumsum(chances / chances.sum())

    def __len__(self) -> int:
        return len(self._items)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch, which the windows depend on."""
        self.epoch = epoch

    def window(self, index: int) -> tuple[int, int, EpisodeKeyframes, list[Link]]:
        """Source, episode, its keyframes, and those of them that an item holds in this epoch.

        A chain's last window is sampled only if it is the only one, as in the released code.
        """
        rng = np.random.default_rng([self.seed, self.epoch, index])
        if self.sampled:
            index = min(
                int(np.searchsorted(self._sample_thresholds, rng.random(), side="right")),
                len(self) - 1,
            )
        number, episode, keyframes, chain = self._items[index]
        begin = int(rng.integers(max(len(chain) - self.length, 1)))
        return number, episode, keyframes, chain[begin : begin + self.length]

    def __getitem__(self, index: int) -> dict[str, Any]:
        number, episode, keyframes, links = self.window(index)
        frames = [link.frame for link in links]
        # one goal for the whole chain, or an error that names them
        goal = self.sources[number].goal(episode)
        sample = KeyframeSample(
            goal=goal,
            shots=keyframes.shots(frames),
            open=keyframes.commanded_open(frames),
            places=np.array([link.place for link in links]),
            targets=keyframes.motions.targets[[link.motion for link in links]],
        )
        item = self.processor.item(sample)
        return item | {"goal": goal, "subgoals": {}, "place": (number, episode, frames[0])}


@TRAINING_SETS.register("keyframes")
def keyframe_dataset(
    sources: Sequence[EpisodeSource],
    processor: PolicyProcessor,
    policy: Policy,
    caches: Sequence[VisionCache] | None,
    *,
    episodes: Sequence[np.ndarray],
    seed: int,
    sampled: bool,
    transforms: Sequence[Perturbation],
    **_: Any,
) -> KeyframeDataset:
    """The samples of a policy that trains on runs of `policy.keyframes` keyframes, else of one."""
    require(
        not transforms,
        "data.history_transforms changes frames, and this policy learns from keyframes: leave it"
        " empty.",
    )
    length = getattr(policy, "keyframes", 1)
    return KeyframeDataset(
        sources, processor, length, episodes=episodes, seed=seed, sampled=sampled
    )
