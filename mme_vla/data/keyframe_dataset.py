"""Training samples of waypoint policies: runs of keyframes of one chain, each with the motion that follows it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from torch.utils.data import Dataset

from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.keyframes import EpisodeKeyframes, Link, file_of
from mme_vla.errors import UserError
from mme_vla.policy.sam2act.scene import Shot


@dataclass(frozen=True)
class KeyframeSample:
    """A run of k keyframes as they are kept, before any processing.

    goal: in words. shots: k times the shots of all cameras. open: [k] whether the gripper's command was to be open.
    places: [k] keyframes since the chain was entered. targets: [k, 7] the motions that follow.
    """

    goal: str
    shots: list[list[Shot]]
    open: np.ndarray
    places: np.ndarray
    targets: np.ndarray


class KeyframeReader(Protocol):
    """What turns samples into what a policy learns from."""

    def keyframe_item(self, sample: KeyframeSample) -> dict[str, Any]: ...


class KeyframeDataset(Dataset[dict[str, Any]]):
    """Every place a sample can begin at, of the chains of several datasets' episodes.

    With `length` 1 an item is one transition, and there is one for every keyframe of every chain. Longer runs are items
    by chain: a window of the chain, drawn anew each epoch; chains that are too short are left out, as released.
    """

    def __init__(
        self,
        sources: Sequence[EpisodeSource],
        processor: KeyframeReader,
        length: int,
        *,
        episodes: Sequence[np.ndarray] | None = None,
        seed: int = 42,
    ) -> None:
        """Find the chains; pictures are not read yet.

        Args:
            length: k; keyframes of a sample.
            episodes: which of each source's episodes to use; None uses all.

        Raises:
            UserError: an episode has no keyframes beside it, or no chain has `length` of them.
        """
        self.sources, self.processor, self.length = list(sources), processor, length
        self.seed, self.epoch = seed, 0
        chosen = [np.arange(len(source)) for source in sources] if episodes is None else episodes
        self.total_frames = 0
        self._items: list[tuple[int, int, EpisodeKeyframes, list[Link]]] = []
        longest = 0
        for number, (source, part) in enumerate(zip(sources, chosen, strict=True)):
            for episode in map(int, part):
                self.total_frames += int(source.lengths[episode])
                kept = EpisodeKeyframes(file_of(source.root, episode))
                for chain in kept.chains:
                    longest = max(longest, len(chain))
                    if length == 1:
                        self._items += [(number, episode, kept, [link]) for link in chain]
                    elif len(chain) >= length:
                        self._items.append((number, episode, kept, chain))
        if not self._items:
            raise UserError(
                f"No chain of keyframes in the data has {length} of them; the longest has {longest}. Train on longer "
                "tasks, or remember fewer (backbone.remembered)."
            )

    def __len__(self) -> int:
        """Number of samples."""
        return len(self._items)

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch, which the windows depend on."""
        self.epoch = epoch

    def window(self, index: int) -> tuple[int, int, EpisodeKeyframes, list[Link]]:
        """Source, episode, its keyframes, and those of them that an item holds in this epoch.

        A chain's last window is drawn only if it is the only one, as in the released code.
        """
        number, episode, kept, chain = self._items[index]
        rng = np.random.default_rng([self.seed, self.epoch, index])
        begin = int(rng.integers(max(len(chain) - self.length, 1)))
        return number, episode, kept, chain[begin : begin + self.length]

    def __getitem__(self, index: int) -> dict[str, Any]:
        number, episode, kept, links = self.window(index)
        frames = [link.frame for link in links]
        sample = KeyframeSample(
            goal=self.sources[number].goal(episode),
            shots=kept.shots(frames),
            open=kept.commanded_open(frames),
            places=np.array([link.place for link in links]),
            targets=kept.motions.targets[[link.motion for link in links]],
        )
        item = self.processor.keyframe_item(sample)
        return item | {"goal": sample.goal, "subgoals": {}, "place": (number, episode, frames[0])}
