"""`mme-vla exec-starts`: where the conditioning videos of a dataset end, as a side file made from
recordings that tell.

`lerobot/robomme` has neither `is_demo` nor `exec_start_idx`. Its episodes are those of the official
HDF5 files, so each is found among them by its goal, its length and its joint angles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from omegaconf import DictConfig

from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes, open_episode
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.embodiment.robomme import ARM_JOINTS
from mme_vla.errors import counted, listed, require
from mme_vla.utils import write_json

# radians on average: a demonstration that was made anew differs a little, another episode by far
# more
NEAR = 0.05
_UNMARKED = replace(ROBOMME_JOINT, conditioning_video=False)


@dataclass(frozen=True)
class AnnotatedEpisode:
    """A recorded episode that says where its video ends.

    goals: its wordings, lower-case.
    joints: [t, 7] radians.
    start: the first execution frame.
    """

    goals: tuple[str, ...]
    joints: np.ndarray
    start: int


def annotated_episodes(inputs: Sequence[str | Path]) -> list[AnnotatedEpisode]:
    """All episodes, in order, of official HDF5 files or their folders, and of LeRobot datasets that
    mark the video.
    """
    episodes: list[AnnotatedEpisode] = []
    for path in inputs:
        if (Path(path) / "meta").is_dir():
            source = EpisodeSource(path)
            for e, start in enumerate(source.exec_starts.tolist()):
                episodes.append(
                    AnnotatedEpisode((source.goal(e),), source.states(e)[:, :ARM_JOINTS], start)
                )
            continue
        for ref in list_episodes(find_files([path])):
            with open_episode(ref) as episode:
                joints = episode.joints()[0].astype(np.float32)
                episodes.append(AnnotatedEpisode(tuple(episode.goals), joints, episode.exec_start))
    return episodes


def first_frames(dataset: str | Path, annotated: Sequence[AnnotatedEpisode]) -> list[int]:
    """The first execution frame of every episode of a dataset that does not mark its videos."""
    source = EpisodeSource(dataset, robot=_UNMARKED)
    matches = []
    for episode in range(len(source)):
        goal = source.goal(episode)
        joints = source.states(episode)[:, :ARM_JOINTS]
        distances: list[tuple[float, int]] = []  # with the start, of every one that may be it
        for one in annotated:
            if len(one.joints) == len(joints) and goal in one.goals:
                distances.append((float(np.abs(one.joints - joints).mean()), one.start))
        nearest = min((distance for distance, _ in distances), default=np.inf)
        starts = sorted({start for distance, start in distances if distance <= nearest + 1e-6})
        near = "none has its goal and length"
        if distances:
            near = f"the nearest is {nearest:.2f} rad away"
        place = f"{source.root}, episode {episode}"
        require(
            nearest <= NEAR,
            f"{place} ({goal!r}, {len(joints)} frames) is not among the {len(annotated)} episodes"
            f" given: {near}. Give the recordings that the dataset was made from, all of them.",
        )
        require(len(starts) <= 1, f"{place}: recordings that fit alike begin at {listed(starts)}.")
        matches.append(starts[0])
    return matches


def main(cfg: DictConfig) -> None:
    """Write the side file as configs/exec_starts.yaml and the command line say."""
    output = Path(cfg.output)
    require(not output.exists(), f"{output} exists: name a new file, nothing is ever written over.")
    episodes = annotated_episodes([cfg.input] if isinstance(cfg.input, str) else list(cfg.input))
    starts = [one.start for one in episodes]
    if cfg.dataset is not None:
        starts = first_frames(cfg.dataset, episodes)
    write_json(output, {str(episode): start for episode, start in enumerate(starts)})
    videos = sum(start > 0 for start in starts)
    print(
        f"{output}: {counted(len(starts), 'episode')}, {videos} of them with a conditioning video."
    )
