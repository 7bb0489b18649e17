"""Training samples of waypoint policies: runs of keyframes of one chain, each with the motion that follows it."""

from collections import Counter
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
    """Runs of keyframes from the chains of several datasets' episodes.

    There are as many samples to an epoch as places to begin at: with `length` 1 one for every transition of every
    chain, else one for every chain that is long enough. What is drawn is fair to tasks, as released: with `length` 1 a
    task, then one of its transitions; else a task, one of its episodes and a chain of that, drawn again where the chain
    is too short, and a window of it. Held-out samples are gone through one by one.
    """

    def __init__(
        self,
        sources: Sequence[EpisodeSource],
        processor: KeyframeReader,
        length: int,
        *,
        episodes: Sequence[np.ndarray] | None = None,
        seed: int = 42,
        drawn: bool = True,
    ) -> None:
        """Find the chains; pictures are not read yet.

        Args:
            length: k; keyframes of a sample.
            episodes: which of each source's episodes to use; None uses all.
            drawn: whether a sample is drawn anew each epoch; else it is the place of its number.

        Raises:
            UserError: an episode has no keyframes beside it, or no chain has `length` of them.
        """
        self.sources, self.processor, self.length = list(sources), processor, length
        self.seed, self.epoch = seed, 0
        chosen = [np.arange(len(source)) for source in sources] if episodes is None else episodes
        self.total_frames, self.drawn = 0, drawn
        self._items: list[tuple[int, int, EpisodeKeyframes, list[Link]]] = []
        shares: list[float] = []  # how often an item is drawn within its task, relative to the task's others
        tasks: list[str] = []
        counted: Counter[str] = Counter()
        longest = 0
        for number, (source, part) in enumerate(zip(sources, chosen, strict=True)):
            for episode in map(int, part):
                self.total_frames += int(source.lengths[episode])
                kept = EpisodeKeyframes(file_of(source.root, episode))
                found = [chain for chain in kept.chains if len(chain) >= length]
                longest = max(longest, *map(len, kept.chains))
                runs = [[link] for chain in found for link in chain] if length == 1 else found
                self._items += [(number, episode, kept, run) for run in runs]
                # An episode too short for any run still takes its turn, and the draw is repeated for all tasks alike.
                counted[source.task(episode)] += 1
                shares += [1.0 if length == 1 else 1 / len(kept.chains)] * len(runs)
                tasks += [source.task(episode)] * len(runs)
        if not self._items:
            raise UserError(
                f"No chain of keyframes in the data has {length} of them; the longest has {longest}. Train on longer "
                "tasks, or remember fewer (backbone.remembered)."
            )
        if length == 1:
            counted = Counter(tasks)
        chances = np.array(shares) / [counted[task] for task in tasks]
        self._drawn_below = np.cumsum(chances / chances.sum())

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
        rng = np.random.default_rng([self.seed, self.epoch, index])
        if self.drawn:
            index = min(int(np.searchsorted(self._drawn_below, rng.random(), side="right")), len(self) - 1)
        number, episode, kept, chain = self._items[index]
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
