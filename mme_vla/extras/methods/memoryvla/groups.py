"""Training samples of MemoryVLA: moments of one episode, in the order of time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mme_vla.data.cache import VisionCache
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.extras.methods.memoryvla.processor import MemoryVlaProcessor
from mme_vla.memory.transforms import FrameMap
from mme_vla.policy.base import Policy
from mme_vla.registry import TRAINING_SETS


class GroupDataset(TrainingDataset):
    """Groups of steps of one episode, sampled from whole records, conditioning videos included.

    Every episode gives as many groups as every other, whatever its length; an epoch shows about as
    many steps as there are. A group's steps are distinct, sampled uniformly and sorted; a shorter
    episode gives all, the last one repeated.
    """

    def __init__(self, *arguments: Any, group_size: int, **options: Any) -> None:
        """Arrange groups of so many steps; the other arguments are those of `TrainingDataset`."""
        super().__init__(*arguments, **options)
        self.group_size = group_size

    def __len__(self) -> int:
        episodes = len(self._episode)
        return episodes * max(round(self.steps / (episodes * self.group_size)), 1)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not 0 <= index < len(self):
            raise IndexError(f"group {index} of {len(self)}")
        at = index % len(self._episode)
        s, episode = int(self._source[at]), int(self._episode[at])
        length = int(self.sources[s].lengths[episode])
        size = self.group_size
        rng = np.random.default_rng([self.seed, self.epoch, index])
        if length >= size:
            frames = np.sort(rng.choice(length, size, replace=False))
        else:
            frames = np.minimum(np.arange(size), length - 1)
        frame_map = self._frame_map(s, episode, frames, index, self.transforms)
        return self._group(s, episode, frames, rng, frame_map)

    def observation(self, index: int) -> dict[str, Any]:
        """The group that ends at a step: the moments before it at which the policy would have been
        asked.
        """
        s, episode, frame = self.locate(index)
        stride = self.processor.embodiment.action.execute
        frames = np.arange(frame, -1, -stride)[: self.group_size][::-1]
        rng = np.random.default_rng([self.seed, self.epoch, index])
        return self._group(s, episode, frames, rng, self._frame_map(s, episode, frames, index, ()))

    def _group(
        self,
        s: int,
        episode: int,
        frames: np.ndarray,
        rng: np.random.Generator,
        frame_map: FrameMap,
    ) -> dict[str, Any]:
        steps = [self.step_at(s, episode, int(frame)) for frame in frames]
        return {
            "moments": [self.inputs_at(step, rng, frame_map) for step in steps],
            "times": frame_map.transformed(frames).astype(np.int64),
            "goal": steps[-1].goal,
            "subgoals": steps[-1].subgoals,
            "place": (s, episode, int(frames[-1])),
        }


@TRAINING_SETS.register("groups")
def group_dataset(
    sources: Sequence[EpisodeSource],
    processor: MemoryVlaProcessor,
    policy: Policy,
    caches: Sequence[VisionCache] | None,
    *,
    sampled: bool,
    **options: Any,
) -> GroupDataset:
    """The samples of a policy that trains on groups of `processor.group_size` steps; held-out ones
    are sampled alike.
    """
    return GroupDataset(
        sources, processor, policy.memory, caches, group_size=processor.group_size, **options
    )
