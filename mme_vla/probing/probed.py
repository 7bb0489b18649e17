"""A policy under an arm of a probe: it is shown, remembers or is told something else, and is itself untouched."""

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode, Host
from mme_vla.probing.arms import UNPROBED, Arm, options_of
from mme_vla.probing.channels import Channel, MemorySnapshot, Remembered, channel_of
from mme_vla.probing.interventions import Moment
from mme_vla.probing.recordings import SUBGOAL, Recording, others, stored_frames
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.types import Noise, stack_noise


class Prober(Host, Protocol):
    """What such an episode asks of the policy that began it."""

    inner: Policy
    arm: Arm
    sessions: list[Recording]

    @property
    def before(self) -> int: ...


class ProbedEpisode(Episode):
    """Shows `inner`, the policy's own episode, what the arm makes of the frames.

    recording: what is shown, where it is a recorded episode. exec_start: its first execution frame, once it is there.
    boundaries: frames, as they are shown, at which sub-tasks began, where that is known.
    said: the subgoals that were set at each chunk so far.
    """

    def __init__(self, prober: Prober, goal: str, seed: int = 0) -> None:
        super().__init__(prober, goal, seed)
        self._prober, self.seed = prober, seed
        self.inner = prober.inner.start_episode(goal, seed)
        self.recording: Recording | None = None
        self.exec_start: int | None = None
        self.boundaries: Sequence[int] = ()
        self.subgoals: list[str | None] = []

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        drawn: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames as `Episode.observe` does."""
        self.inner.goal = self.goal
        feed, count = self._prober.arm.feed, len(states)
        demo = np.broadcast_to(np.asarray(is_demo, bool), (count,))
        video = int(demo.sum())
        if not self.n_observed_frames:
            self._show_sessions()
        if self.exec_start is None and video < count:
            self.exec_start = self.n_observed_frames + video
        chunk = _Frames(frames, np.asarray(states), demo, actions, drawn, self._robot.action.frames is None)
        if feed.video:
            chunk.show(self.inner, 0, video)
        pause = -1 if self.exec_start is None else self.exec_start + feed.at - self.n_observed_frames
        if feed.stills and video <= pause < count:
            chunk.show(self.inner, video, pause + 1)
            chunk.hold(self.inner, pause, feed.stills)
            video = pause + 1
        chunk.show(self.inner, video, count)
        self.n_observed_frames += count

    def _show_sessions(self) -> None:
        stored, before = stored_frames(self._prober.inner, self._prober.before), 0
        for recording in self._prober.sessions:
            here = None if stored is None else stored[stored >= before] - before
            recording.show(self.inner, 0, recording.length, here, video=True)
            before += recording.length

    def set_subgoal(self, subgoal: str | None) -> None:
        """Tell the policy's own episode what the arm made of the subgoal."""
        self.inner.subgoal = subgoal

    def begun(self, frames: Sequence[int], exec_start: int) -> None:
        """Note where sub-tasks began, the execution among them, as the frames are shown."""
        starts = np.array(sorted({0, exec_start, *frames}), np.int64)
        displayed = self._prober.arm.feed.displayed(starts, exec_start, self._prober.before)
        self.boundaries = [int(frame) for frame in displayed if frame >= 0]

    @property
    def state(self) -> Tensor:
        return self.inner.state

    def acted(self, chunk: np.ndarray) -> None:
        self.inner.acted(chunk)

    def remember(
        self,
        frames: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        states: np.ndarray | None = None,
    ) -> None:
        """Not offered: an arm decides on whole observations."""
        raise UserError("A probed episode takes whole observations: observe(), not remember() and look().")

    def look(self, images: Mapping[str, np.ndarray], state: np.ndarray) -> None:
        """Not offered: an arm decides on whole observations."""
        raise UserError("A probed episode takes whole observations: observe(), not remember() and look().")


class _Frames:
    """What one `observe` was given, shown part by part."""

    def __init__(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        demo: np.ndarray,
        actions: np.ndarray | None,
        drawn: Mapping[str, np.ndarray] | None,
        motions: bool,
    ) -> None:
        self._frames, self._states, self._demo = frames, states, demo
        self._actions, self._rendered, self._motions = actions, drawn, motions
        self._video, self._has_motions = int(demo.sum()), False

    def show(self, episode: Episode, start: int, stop: int) -> None:
        """Let an episode observe frames start … stop − 1."""
        if stop <= start:
            return
        views, rendered = self._views(start, stop)
        led = self._actions
        if led is not None and start >= self._video:
            led = led[:0] if self._motions and self._has_motions else led
            led = led if self._motions else led[start - self._video : stop - self._video]
            self._has_motions = True
        elif start < self._video:
            led = None
        episode.observe(views, self._states[start:stop], self._demo[start:stop], led, **rendered)

    def hold(self, episode: Episode, at: int, count: int) -> None:
        """Let an episode observe one frame `count` times more, holding the action that led to it."""
        views, rendered = self._views(at, at + 1)
        views = {name: np.repeat(view, count, 0) for name, view in views.items()}
        if rendered:
            rendered = {
                "drawn": {n: np.arange(count) if len(views[n]) else places for n, places in rendered["drawn"].items()}
            }
        led = self._actions
        if led is not None:
            led = led[:0] if self._motions else np.repeat(led[at - self._video : at - self._video + 1], count, 0)
        episode.observe(views, np.repeat(self._states[at : at + 1], count, 0), False, led, **rendered)

    def _views(self, start: int, stop: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        if self._rendered is None:
            return {name: view[start:stop] for name, view in self._frames.items()}, {}
        places = {name: np.asarray(at, np.int64) for name, at in self._rendered.items()}
        inside = {name: (at >= start) & (at < stop) for name, at in places.items()}
        views = {
            name: view[inside[name]] if name in inside else view[start:stop] for name, view in self._frames.items()
        }
        return views, {"drawn": {name: places[name][inside[name]] - start for name in places}}


ALIKE = 3  # of the other episodes, so many with the most similar goals lend


class DonorEpisode:
    """A recorded episode that a policy has seen."""

    def __init__(self, policy: Policy, channel: Channel, recording: Recording) -> None:
        self._channel, self.recording = channel, recording
        self._said = subgoal_kind(policy) or SUBGOAL
        self._episode: Episode | None = None
        self._policy = policy

    def store_of(self, episode: ProbedEpisode) -> Callable[[str], Remembered]:
        """The store of a name, as many execution frames in as `episode` is; of banks, as it was in the end."""

        def store(name: str) -> Remembered:
            step = self._step(episode) if self._channel.chooses else None
            stores = {store.name: store for store in self._channel.read(self._seen(), step).stores}
            return stores[name]

        return store

    def subgoal_of(self, episode: ProbedEpisode) -> str | None:
        """What was said there, as many execution frames in."""
        if self._said not in self.recording.source.subgoal_names:
            return None
        return self.recording.subgoal(self._step(episode), self._said)

    def _step(self, episode: ProbedEpisode) -> int:
        executed = episode.n_observed_frames - 1 - (episode.exec_start or 0)
        return min(self.recording.exec_start + max(executed, 0), self.recording.length - 1)

    def _seen(self) -> Episode:
        if self._episode is None:
            recording, policy = self.recording, self._policy
            running, seen = policy.start_episode(recording.goal), 0
            # A bank is written where chunks are chosen; of stored frames any moment can be asked for afterwards.
            stops = [] if self._channel.chooses else recording.decisions(policy.embodiment.action.execute, None)
            for stop in stops:
                recording.show(running, seen, stop + 1)
                seen = stop + 1
                running.subgoal = recording.subgoal(stop, self._said)
                policy.act([running])
            recording.show(running, seen, recording.length, stored_frames(policy, recording.length))
            self._episode = running
        return self._episode


class DonorEpisodes:
    """Who lends to whom: for each episode always the same, one of those whose goals are most alike."""

    def __init__(self, policy: Policy, channel: Channel, recordings: Sequence[Recording]) -> None:
        self._policy, self._channel, self._recordings = policy, channel, list(recordings)
        self._donors: dict[str, DonorEpisode] = {}

    def of(self, episode: ProbedEpisode) -> DonorEpisode:
        """Who lends to this episode."""
        alike = others(self._recordings, episode.recording, episode.goal)[:ALIKE]
        donor = alike[int(np.random.default_rng(episode.seed).integers(len(alike)))]
        if donor.name not in self._donors:
            self._donors[donor.name] = DonorEpisode(self._policy, self._channel, donor)
        return self._donors[donor.name]


class ProbedPolicy(Policy):
    """`inner` under an arm. It evaluates and rolls out as any policy does; its noise is that of the unprobed one."""

    def __init__(
        self,
        inner: Policy,
        arm: Arm = UNPROBED,
        sessions: Sequence[Recording] = (),
        donors: DonorEpisodes | None = None,
        of_split: bool = False,
    ) -> None:
        """Stand before a policy.

        Args:
            sessions: what is shown before each episode, as far as the arm asks for it.
            donors: other episodes to take from. of_split: the sessions are those of a stress split.
        """
        super().__init__()
        self.inner, self.arm, self.channel = inner, arm, channel_of(inner)
        self.memory, self.processor = inner.memory, inner.processor
        self.config = {**inner.config, **({"probe": [arm.name, options_of(arm)]} if arm.parts else {})}
        self.history_dtype, self.horizon, self.n_past_steps = inner.history_dtype, inner.horizon, inner.n_past_steps
        self.sample_steps, self.action_dim = inner.sample_steps, inner.action_dim
        self.max_actions = inner.max_actions
        self.sessions, self.donors = list(sessions)[: arm.feed.sessions], donors
        self.n_distractor_episodes = len(self.sessions) if of_split else 0  # those of an arm are the probe's own

    @property
    def before(self) -> int:
        """Frames of the sessions."""
        return sum(recording.length for recording in self.sessions)

    def start_episode(self, goal: str, seed: int = 0) -> ProbedEpisode:
        """Begin an episode, with the sessions that come before it."""
        return ProbedEpisode(self, goal, seed)

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        return self.inner.sampling_noise(generator)

    def sample_actions(self, batch: Any, draws: Mapping[str, Tensor] | None = None, steps: int | None = None) -> Tensor:
        return self.inner.sample_actions(batch, draws, steps)

    def encode_frames(self, frames: np.ndarray) -> Tensor:
        return self.inner.encode_frames(frames)

    def vision_fingerprint(self) -> str:
        return self.inner.vision_fingerprint()

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """The episode's own frames that are looked at, through what the arm makes of them."""
        feed, before = self.arm.feed, self.before
        displayed = feed.displayed(steps, exec_start, before)
        reads = self.inner.frames_read(displayed, feed.first_executed(exec_start, before))
        if reads is None:
            return None
        if "choice" in self.arm.needs and len(displayed):  # which frames are left to choose from, only then is known
            stored = stored_frames(self.inner, int(displayed.max()) + 1)
            reads = reads if stored is None else np.union1d(reads, stored)
        paused = [exec_start + feed.at] if feed.stills else []
        return np.union1d(feed.source_frames(reads, exec_start, before), np.array(paused, np.int64))

    def observation(self, episodes: Sequence[Episode]) -> Any:
        for episode in map(_probed, episodes):
            episode.subgoals.append(episode.subgoal)
            episode.set_subgoal(self.arm.say(episode.subgoal, self.moment(episode)))
        return self.inner.observation([_probed(episode).inner for episode in episodes])

    def answer(
        self, batch: Any, episodes: Sequence[Episode], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        mine = [_probed(episode) for episode in episodes]
        if not self.arm.edits:
            return self.inner.answer(batch, [episode.inner for episode in mine], draws, steps)
        remembering = []
        for i, episode in enumerate(mine):
            sampled = {name: value[i] for name, value in draws.items()}
            snapshot, stores = self.snapshot(episode, sampled)
            remembering.append(self.channel.counterfactual(episode.inner, snapshot, stores))
        chunk = self.channel.answer(batch, remembering, draws, steps)
        for episode, its in zip(mine, remembering, strict=True):
            self.channel.commit(episode.inner, its)
        return chunk

    def snapshot(self, episode: ProbedEpisode, sampled: Noise | None = None) -> tuple[MemorySnapshot, list[Remembered]]:
        """What is remembered among the frames that may be, and what the arm makes of it."""
        moment = self.moment(episode)
        snapshot = self.channel.read(episode.inner, only=self.arm.only(moment))
        edited = []
        for place, store in enumerate(snapshot.stores):
            weigh = None if sampled is None else partial(self._weigh, episode, snapshot, place, sampled)
            edited.append(self.arm.edit(store, self.moment(episode, weigh)))  # the same chance for each store
        return snapshot, edited

    def moment(self, episode: ProbedEpisode, weigh: Any = None) -> Moment:
        """What the arm may know now."""
        now = max(episode.inner.n_observed_frames - 1, 0)
        stored = np.zeros(0, np.int64) if self.memory is None else self.memory.storage.stored_frames(now + 1)
        rng = np.random.default_rng([episode.seed, now, zlib.crc32(self.arm.name.encode())])
        known: dict[str, Any] = {}
        if self.donors is not None:
            donor = self.donors.of(episode)
            known = {"donor": donor.store_of(episode), "donor_subgoal": donor.subgoal_of(episode)}
        return Moment(rng, now, stored, episode.boundaries, episode.subgoals, weigh=weigh, **known)

    def _weigh(
        self, episode: ProbedEpisode, snapshot: MemorySnapshot, place: int, sampled: Noise, store: Remembered
    ) -> np.ndarray:
        """By how much a chunk changes without each slot of a store."""
        slots = store.occupied
        variants = [store, *(store.without([slot]) for slot in slots)]
        stores = [[*snapshot.stores[:place], v, *snapshot.stores[place + 1 :]] for v in variants]
        chunks = self.ask(episode, snapshot, stores, [sampled])
        changes = np.zeros(len(store))
        changes[slots] = (chunks[1:, 0] - chunks[0, 0]).square().mean((1, 2)).sqrt().numpy()
        return changes

    @torch.no_grad()
    def ask(
        self,
        episode: ProbedEpisode,
        snapshot: MemorySnapshot,
        variants: Sequence[Sequence[Remembered]],
        draws: Sequence[Noise],
        steps: int | None = None,
        batch: int = 64,
    ) -> Tensor:
        """Normalised chunks [variants, draws, h, w] as they are executed, adding nothing to the episode's memory.

        Args:
            variants: what is remembered, store by store. draws: the random numbers that all variants share.
            batch: most chunks that are chosen at once.
        """
        chunks = []
        pairs = [(variant, sampled) for variant in variants for sampled in draws]
        ready = {id(variant): self.channel.counterfactual(episode.inner, snapshot, variant) for variant in variants}
        for start in range(0, len(pairs), batch):
            part = pairs[start : start + batch]
            observation = self.inner.observation([episode.inner] * len(part))
            stacked = stack_noise([sampled for _, sampled in part])
            chunks.append(
                self.channel.answer(observation, [ready[id(v)] for v, _ in part], stacked, steps).float().cpu()
            )
        action = self.embodiment.action
        stacked_chunks = torch.cat(chunks).unflatten(0, (len(variants), len(draws)))
        return stacked_chunks[:, :, self.n_past_steps : self.n_past_steps + action.execute, : action.width]


def _probed(episode: Episode) -> ProbedEpisode:
    """An episode of a probed policy."""
    assert isinstance(episode, ProbedEpisode)
    return episode
