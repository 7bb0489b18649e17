"""Frames on their way from an environment to a policy: other episodes first, no video, or frames
transformed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from mme_vla.data.sources import open_sources
from mme_vla.envs.metadata import SESSIONS, read_variant
from mme_vla.errors import UserError
from mme_vla.extras.probing.recordings import Recording, all_recordings, stored_frames
from mme_vla.memory.base import MemoryModule
from mme_vla.memory.transforms import HistoryTransform, map_frames
from mme_vla.policy.base import Policy, PolicyInfo
from mme_vla.policy.episode import Episode, Host
from mme_vla.registry import SPLIT_POLICIES
from mme_vla.types import Noise


@dataclass(frozen=True)
class Feed:
    """Changes which frames of an episode a policy observes. The default changes nothing.

    sessions: unrelated episodes that come first, as part of the conditioning video. video: whether
    the conditioning video is shown. transforms: of the frames, those that training applies, in this
    order.
    """

    sessions: int = 0
    video: bool = True
    transforms: tuple[HistoryTransform, ...] = ()

    @property
    def drops(self) -> bool:
        """Whether frames of the execution may be left out."""
        return any(transform.drops for transform in self.transforms)

    def repeats(self, frames: np.ndarray, exec_start: int) -> np.ndarray:
        """How often each of the episode's frames [n] is observed, int64 [n]."""
        frames = np.asarray(frames, np.int64)
        if not len(frames):
            return np.zeros(0, np.int64)
        return self._counts(int(frames.max()) + 1, exec_start)[frames]

    def _counts(self, length: int, exec_start: int) -> np.ndarray:
        """How often each of the first `length` frames is observed."""
        real = map_frames(self.transforms, length, exec_start).real
        counts = np.bincount(real, minlength=length)
        counts[:exec_start] *= self.video
        return counts

    def displayed(self, frames: np.ndarray, exec_start: int, before: int = 0) -> np.ndarray:
        """The episode's frames [n] as numbers of observed frames, int64 [n]; −1 for one that is
        left out.

        exec_start: the episode's first execution frame. before: frames of the sessions.
        """
        frames = np.asarray(frames, np.int64)
        counts = self._counts(int(frames.max(initial=0)) + 1, exec_start)
        last = before + np.cumsum(counts)[frames] - 1  # of a repeated frame: its last repeat
        return np.where(counts[frames] > 0, last, -1)

    def first_executed(self, exec_start: int, before: int = 0) -> int:
        """The number of the first execution frame among the observed ones."""
        return before + int(self._counts(exec_start, exec_start).sum())

    def source_frames(self, displayed: np.ndarray, exec_start: int, before: int = 0) -> np.ndarray:
        """The episode's frames behind observed ones [m], ascending, each once; those of sessions
        are left out.
        """
        displayed = np.asarray(displayed, np.int64) - before
        displayed = displayed[displayed >= 0]
        if not len(displayed):
            return displayed
        length = exec_start + int(displayed.max()) + 1
        while (counts := self._counts(length, exec_start)).sum() <= displayed.max():
            length *= 2
        return np.unique(np.repeat(np.arange(length), counts)[displayed])


class FeedHost(Host, Protocol):
    """What a fed episode needs of the policy that began it."""

    inner: Policy
    feed: Feed
    sessions: list[Recording]

    @property
    def before(self) -> int: ...


class FedEpisode(Episode):
    """Passes frames on to `inner`, the policy's own episode, through a feed.

    exec_start: the first execution frame, once it is observed. boundaries: observed frames at which
    sub-tasks began, where the environment reports them.
    """

    def __init__(self, host: FeedHost, goal: str, seed: int = 0) -> None:
        super().__init__(host, goal, seed)
        self._host, self.seed = host, seed
        self.inner = host.inner.start_episode(goal, seed)
        self.exec_start: int | None = None
        self._counts: np.ndarray = np.zeros(0, np.int64)
        self._starts: np.ndarray = np.zeros(0, np.int64)
        self.boundaries: Sequence[int] = ()

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        rendered: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames as `Episode.observe` does."""
        self.inner.goal, self.inner.options = self.goal, self.options
        states, length = np.asarray(states), len(states)
        numbers = self.n_observed_frames + np.arange(length)
        demo = np.broadcast_to(np.asarray(is_demo, bool), (length,))
        video = int(demo.sum())
        if not self.n_observed_frames:
            self._observe_sessions()
        if self.exec_start is None and video < length:
            self.exec_start = self.n_observed_frames + video
        self.n_observed_frames += length

        # How often each frame is observed; the one at which the policy decides always is.
        exec_start = self.n_observed_frames if self.exec_start is None else self.exec_start
        repeats = self._host.feed.repeats(numbers, exec_start)
        if self._host.feed.drops and video < length:
            repeats[-1] = max(repeats[-1], 1)
        self._counts = np.concatenate([self._counts, repeats])
        order = np.repeat(np.arange(length), repeats)

        # The actions that led to those of the execution.
        executed = order[order >= video]
        if actions is not None and self._robot.action.frames is not None:
            actions = np.asarray(actions)[executed - video]
        elif not len(executed):
            actions = None

        views, places = {}, {}
        for name, view in frames.items():
            with_images = np.arange(length)
            if rendered is not None and name in rendered:
                with_images = np.asarray(rendered[name])
            places[name] = np.flatnonzero(np.isin(order, with_images))
            views[name] = view
            if (repeats != 1).any():
                views[name] = view[np.searchsorted(with_images, order[places[name]])]
        if rendered is None:
            self.inner.observe(views, states[order], demo[order], actions)
        else:
            visible = {name: places[name] for name in rendered}
            self.inner.observe(views, states[order], demo[order], actions, rendered=visible)
        if len(self._starts):
            self.boundaries = self.numbers(self._starts)

    def _observe_sessions(self) -> None:
        stored, before = stored_frames(self._host.inner, self._host.before), 0
        for recording in self._host.sessions:
            of_recording = None if stored is None else stored[stored >= before] - before
            recording.show(self.inner, 0, recording.length, of_recording, video=True)
            before += recording.length

    def restart_clock(self) -> None:
        self.inner.restart_clock()

    def begun(self, frames: Sequence[int], exec_start: int) -> None:
        """Note where sub-tasks began, the execution among them, as numbers of observed frames."""
        self._starts = np.array(sorted({0, exec_start, *frames}), np.int64)
        self.boundaries = self.numbers(self._starts)

    def numbers(self, frames: np.ndarray) -> list[int]:
        """The episode's frames [n] as numbers of observed frames, without those that are not
        observed.
        """
        frames = frames[frames < len(self._counts)]
        last = self._host.before + np.cumsum(self._counts)[frames] - 1
        numbers: list[int] = last[self._counts[frames] > 0].tolist()
        return numbers

    @property
    def state(self) -> Tensor:
        return self.inner.state

    def acted(self, chunk: np.ndarray) -> None:
        self.inner.acted(chunk)

    def add_frames(self, *_: Any, **__: Any) -> None:
        """Not offered: a feed decides on whole observations."""
        raise UserError(
            "A probed episode takes whole observations: observe(), not add_frames() and set_view()."
        )

    set_view = add_frames


class FedPolicy(Policy):
    """`inner` with a feed before it. It evaluates and rolls out as any policy does, with the same
    noise.
    """

    def __init__(self, inner: Policy, feed: Feed, sessions: Sequence[Recording] = ()) -> None:
        """Wrap a policy.

        sessions: recorded episodes; the first `feed.sessions` of them are observed before each
        episode.
        """
        super().__init__()
        self.inner, self.feed, self.sessions = inner, feed, list(sessions)[: feed.sessions]
        self.memory, self.processor, self.config = inner.memory, inner.processor, dict(inner.config)
        self.horizon = inner.horizon
        # Episodes of a stress split's sessions count, those of a probe's arm do not.
        self.info = PolicyInfo(
            sample_steps=inner.info.sample_steps,
            max_actions=inner.info.max_actions,
            history_dtype=inner.info.history_dtype,
        )

    @property
    def before(self) -> int:
        """Frames of the sessions."""
        return sum(recording.length for recording in self.sessions)

    def start_episode(self, goal: str, seed: int = 0) -> Episode:
        return FedEpisode(self, goal, seed)

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        return self.inner.sampling_noise(generator)

    def sample_actions(
        self, batch: Any, draws: Mapping[str, Tensor] | None = None, steps: int | None = None
    ) -> Tensor:
        return self.inner.sample_actions(batch, draws, steps)

    def require_memory(self) -> MemoryModule:
        return self.inner.require_memory()

    def vision_fingerprint(self) -> str:
        return self.inner.vision_fingerprint()

    def encode_frames(self, frames: np.ndarray) -> Tensor:
        return self.inner.encode_frames(frames)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """The episode's frames that the policy reads through the feed; None for all, where the feed
        leaves some out.
        """
        if self.feed.drops:
            return None
        displayed = self.feed.displayed(steps, exec_start, self.before)
        reads = self.inner.frames_read(displayed, self.feed.first_executed(exec_start, self.before))
        if reads is None:
            return None
        paused = np.flatnonzero(
            self.feed.repeats(np.arange(int(max(steps, default=-1)) + 1), exec_start) > 1
        )
        return np.union1d(self.feed.source_frames(reads, exec_start, self.before), paused)

    def observation(self, episodes: Sequence[Episode]) -> Any:
        inner = [inner_episode(episode) for episode in episodes]
        for episode, custom in zip(episodes, inner, strict=True):
            custom.subgoal = episode.subgoal
        return self.inner.observation(inner)

    def predict_chunk(
        self,
        batch: Any,
        episodes: Sequence[Episode],
        draws: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        return self.inner.predict_chunk(
            batch, [inner_episode(episode) for episode in episodes], draws, steps
        )


def inner_episode(episode: Episode) -> Episode:
    """The policy's own episode behind a fed one."""
    assert isinstance(episode, FedEpisode)
    return episode.inner


@SPLIT_POLICIES.register(SESSIONS)
def with_sessions(policy: Policy, split: str, recordings: Any) -> Policy:
    """The policy as a split with sessions evaluates it: it observes them before each episode.

    They are the first of the recorded episodes, the same before every episode, and count as part of
    its video.

    Args:
        recordings: datasets, as `data.sources` names them; recorded episodes; or None.
    """
    variant = read_variant(split)
    count = 0 if variant is None else variant.sessions
    if not count:
        return policy
    recordings = recorded_episodes(policy, recordings)
    if policy.embodiment.readings or count > len(recordings):
        raise UserError(
            f"split={split} needs {count} recorded episodes to take from, and there are"
            f" {len(recordings)}: name them with recordings=…."
        )
    fed = FedPolicy(policy, Feed(sessions=count), recordings).eval()
    fed.info = replace(fed.info, n_distractor_episodes=count)
    # The names are those of the probe's arm, so that runs of earlier versions continue.
    fed.config["probe"] = [f"distract:{count}", [{"intervention": "Distract", "sessions": count}]]
    fed.config["sessions"] = [recording.name for recording in fed.sessions]
    return fed


def recorded_episodes(policy: Policy, recordings: Any) -> list[Recording]:
    """The recorded episodes of datasets; recorded episodes as they are, and none for None."""
    if recordings is None:
        return []
    if isinstance(recordings, Sequence) and all(isinstance(one, Recording) for one in recordings):
        return list(recordings)
    return all_recordings(open_sources(recordings, policy.embodiment))
