"""`GroupDataset`: samples that are groups of steps of one episode, for policies trained on sequences."""

from typing import Any

import numpy as np

from mme_vla.data.dataset import TrainingDataset


class GroupDataset(TrainingDataset):
    """Groups of `processor.group_size` steps, drawn from whole records, conditioning videos included.

    Every episode gives as many groups as every other, whatever its length; an epoch shows about as many steps as there
    are. A group's steps are distinct, drawn uniformly and sorted; a shorter episode gives all, the last one repeated.
    """

    def __len__(self) -> int:
        """Number of groups in an epoch."""
        episodes = len(self._episode)
        return episodes * max(round(self.steps / (episodes * self.processor.group_size)), 1)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if not 0 <= index < len(self):
            raise IndexError(f"group {index} of {len(self)}")
        at = index % len(self._episode)
        s, episode = int(self._source[at]), int(self._episode[at])
        length, size = int(self.sources[s].lengths[episode]), self.processor.group_size
        rng = np.random.default_rng([self.seed, self.epoch, index])
        if length >= size:
            frames = np.sort(rng.choice(length, size, replace=False))
        else:
            frames = np.minimum(np.arange(size), length - 1)
        return self._group(s, episode, frames, rng)

    def observation(self, index: int) -> dict[str, Any]:
        """The group that ends at a step: the moments before it at which the policy would have been asked."""
        s, episode, frame = self.locate(index)
        stride = self.processor.embodiment.action.execute
        frames = np.arange(frame, -1, -stride)[: self.processor.group_size][::-1]
        return self._group(s, episode, frames, np.random.default_rng([self.seed, self.epoch, index]))

    def _group(self, s: int, episode: int, frames: np.ndarray, rng: np.random.Generator) -> dict[str, Any]:
        steps = [self.step_at(s, episode, int(frame)) for frame in frames]
        return {
            "moments": [self.seen(step, rng) for step in steps],
            "times": frames.astype(np.int64),
            "goal": steps[-1].goal,
            "subgoals": steps[-1].subgoals,
            "place": (s, episode, int(frames[-1])),
        }
