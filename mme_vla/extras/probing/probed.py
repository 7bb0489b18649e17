"""A policy under an arm of a probe: its frames, its memory or its subgoal are changed, its weights
are not.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError, require
from mme_vla.extras.probing.arms import UNPROBED, Arm, options_of
from mme_vla.extras.probing.channels import (
    Channel,
    MemorySnapshot,
    Remembered,
    channel_of,
    selectable,
)
from mme_vla.extras.probing.interventions import Moment
from mme_vla.extras.probing.recordings import SUBGOAL, Recording, stored_frames
from mme_vla.extras.probing.streams import Shown
from mme_vla.policy.base import Policy, PolicyInfo
from mme_vla.policy.episode import Episode, Failure
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.types import Noise, stack_noise


class ProbedEpisode(Episode):
    """Passes frames on to `inner`, the policy's own episode, as an arm's feed shows them.

    exec_start: the first execution frame, once it is observed.
    boundaries: observed frames at which sub-tasks began, where the environment reports them.
    recording: the recorded episode, if it is one.
    subgoals: those that were set at each chunk before the current one.
    """

    policy: "ProbedPolicy"
    recording: Recording | None = None

    def __init__(self, policy: "ProbedPolicy", goal: str, seed: int = 0) -> None:
        super().__init__(policy, goal, seed)
        self.seed = seed
        self.inner = policy.inner.start_episode(goal, seed)
        self.exec_start: int | None = None
        self._collected: Shown | None = None
        """Frames since the last decision, where the arm changes them; with `renews` all frames."""
        self._start: np.ndarray | None = None
        self._before: dict[str, np.ndarray] = {}
        self._counts: np.ndarray = np.zeros(0, np.int64)
        self._starts: np.ndarray = np.zeros(0, np.int64)
        self.boundaries: Sequence[int] = ()
        self.subgoals: list[str | None] = []

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        rendered: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames as `Episode.observe` does."""
        self.inner.goal = self.goal
        self.inner.options = self.options
        states = np.asarray(states)
        length = len(states)
        demo = np.broadcast_to(np.asarray(is_demo, bool), (length,))
        video = int(demo.sum())
        numbers = self.n_observed_frames + np.arange(length)
        if not self.n_observed_frames:
            _show_all(self.policy.sessions, self.inner, self.policy.inner)
        if self.exec_start is None and video < length:
            self.exec_start = self.n_observed_frames + video
        self.n_observed_frames += length

        # How often each frame is observed; the one at which the policy decides always is.
        exec_start = self.n_observed_frames if self.exec_start is None else self.exec_start
        repeats = self.policy.feed.repeats(numbers, exec_start)
        if self.policy.feed.drops and video < length:
            repeats[-1] = max(repeats[-1], 1)
        self._counts = np.concatenate([self._counts, repeats])
        order = np.repeat(np.arange(length), repeats)

        # The actions that led to those of the execution.
        executed = order[order >= video]
        if actions is not None and self._robot.action.frames is not None:
            actions = np.asarray(actions)[executed - video]
        elif not len(executed):
            actions = None

        # Of each camera, the observed frames that have an image, and these.
        views = {}
        places = {}
        for name, view in frames.items():
            with_images = np.arange(length)
            if rendered is not None and name in rendered:
                with_images = np.asarray(rendered[name])
            places[name] = np.flatnonzero(np.isin(order, with_images))
            views[name] = view
            if (repeats != 1).any():
                views[name] = view[np.searchsorted(with_images, order[places[name]])]
        if self.policy.arm.shows:
            self._collect(views, states[order], demo[order], numbers[order], actions)
        elif rendered is None:
            self.inner.observe(views, states[order], demo[order], actions)
        else:
            visible = {name: places[name] for name in rendered}
            self.inner.observe(views, states[order], demo[order], actions, rendered=visible)
        if len(self._starts):
            self.boundaries = self.numbers(self._starts)

    def _collect(
        self,
        views: Mapping[str, np.ndarray],
        states: np.ndarray,
        demo: np.ndarray,
        numbers: np.ndarray,
        actions: np.ndarray | None,
    ) -> None:
        """Keep frames until the policy decides."""
        width = self._robot.action.width
        executed = np.zeros((len(states), width), np.float32)
        led = np.zeros(len(demo), bool)
        motions: np.ndarray = np.zeros((0, width), np.float32)
        if actions is not None and self._robot.action.frames is None:
            motions = np.asarray(actions, np.float32)
        elif actions is not None:
            executed[~demo] = actions
            led = ~demo
        if self._start is None and not demo.all():
            self._start = np.asarray(states[int(demo.sum())], np.float32)
        new = Shown(
            views=views,
            states=np.asarray(states, np.float32),
            demo=demo,
            numbers=numbers,
            actions=executed,
            led=led,
            motions=motions,
            ends=np.full(len(motions), numbers.max(initial=0)),
            before={},
            start=self._start,
        )
        self._collected = new if self._collected is None else self._collected.join(new)

    def show_collected(self) -> None:
        """Show the policy the frames that were collected, as the arm has them."""
        arm = self.policy.arm
        collected = self._collected
        if not arm.shows or collected is None:
            return
        before = self._before or {name: view[:0] for name, view in collected.views.items()}
        shown = arm.show(replace(collected, before=before), self.policy.moment(self))
        if arm.renews:
            # Another seed at each decision: the noise of one is not that of the others. A decision
            # that failed, such as for memory, is repeated: it is still the same one.
            if self.inner.n_observed_frames > self.policy.n_before:
                self.inner.close()
                self.inner = self.policy.inner.start_episode("", self.seed + len(self.subgoals))
                _show_all(self.policy.sessions, self.inner, self.policy.inner)
            self.inner.options = self.options
        else:
            self._collected = None
        if arm.lag and not arm.renews:
            for name, view in collected.views.items():
                executed = view[~collected.demo]
                self._before[name] = np.concatenate([before[name], executed])[-arm.lag :]
        shown.observe_in(self.inner)

    @property
    def failure(self) -> Failure | None:
        return self.inner.failure

    def close(self) -> None:
        self.inner.close()

    def restart_clock(self) -> None:
        self.inner.restart_clock()

    def note_subtask_starts(self, frames: Sequence[int], exec_start: int) -> None:
        """Note where sub-tasks began, the execution among them, as numbers of observed frames."""
        self._starts = np.array(sorted({0, exec_start, *frames}), np.int64)
        self.boundaries = self.numbers(self._starts)

    def numbers(self, frames: np.ndarray) -> list[int]:
        """The episode's frames [n] as numbers of observed frames, without those that are not
        observed.
        """
        frames = frames[frames < len(self._counts)]
        last = self.policy.n_before + np.cumsum(self._counts)[frames] - 1
        numbers: list[int] = last[self._counts[frames] > 0].tolist()
        return numbers

    @property
    def state(self) -> Tensor:
        return self.inner.state

    def acted(self, chunk: np.ndarray) -> None:
        self.inner.acted(chunk)
        self.subgoals.append(self.subgoal)

    def add_frames(self, *_: Any, **__: Any) -> None:
        """Not offered: a feed decides on whole observations."""
        raise UserError(
            "A probed episode takes whole observations: observe(), not add_frames() and set_view()."
        )

    set_view = add_frames


ALIKE = 3  # episodes with the most similar goals among which a donor is chosen


class DonorEpisode:
    """A recorded episode that a policy has observed, from which contents are taken."""

    def __init__(self, policy: Policy, channel: Channel, recording: Recording) -> None:
        self._channel, self.recording = channel, recording
        self._subgoal_kind = subgoal_kind(policy) or SUBGOAL
        self._episode: Episode | None = None
        self._policy = policy

    def store(self, episode: ProbedEpisode, name: str) -> Remembered:
        """The store of this name, as many execution frames in as `episode` is; of banks, as it was
        in the end.
        """
        step = self._step(episode) if self._channel.chooses else None
        stores = self._channel.read(self._observed(), step).stores
        return next(store for store in stores if store.name == name)

    def subgoal_of(self, episode: ProbedEpisode) -> str | None:
        """The subgoal there, as many execution frames in."""
        if self._subgoal_kind not in self.recording.source.subgoal_names:
            return None
        return self.recording.subgoal(self._step(episode), self._subgoal_kind)

    def _step(self, episode: ProbedEpisode) -> int:
        executed = episode.n_observed_frames - 1 - (episode.exec_start or 0)
        return min(self.recording.exec_start + max(executed, 0), self.recording.length - 1)

    def _observed(self) -> Episode:
        """The episode, once it has run."""
        if self._episode is not None:
            return self._episode
        recording, policy = self.recording, self._policy
        running = policy.start_episode(recording.goal)
        n_observed = 0
        # A bank is written where chunks are chosen; stored frames can be read at any step
        # afterwards.
        if not self._channel.chooses:
            for stop in recording.decisions(policy.embodiment.action.execute, None):
                recording.show(running, n_observed, stop + 1)
                n_observed = stop + 1
                running.subgoal = recording.subgoal(stop, self._subgoal_kind)
                policy.act([running])
        required = stored_frames(policy, recording.length)
        recording.show(running, n_observed, recording.length, required)
        self._episode = running
        return running


class DonorEpisodes:
    """The donor of each episode: always the same, one of those whose goals are most alike."""

    def __init__(self, policy: Policy, channel: Channel, recordings: Sequence[Recording]) -> None:
        self._policy, self._channel, self._recordings = policy, channel, list(recordings)
        self._donors: dict[str, DonorEpisode] = {}

    def of(self, episode: ProbedEpisode) -> DonorEpisode:
        """The donor of this episode."""
        alike = others(self._recordings, episode.recording, episode.goal)[:ALIKE]
        donor = alike[int(np.random.default_rng(episode.seed).integers(len(alike)))]
        if donor.name not in self._donors:
            self._donors[donor.name] = DonorEpisode(self._policy, self._channel, donor)
        return self._donors[donor.name]

    def goal_for(self, episode: ProbedEpisode) -> str | None:
        """A goal that reads like this episode's and differs; None where all are the same."""
        alike = others(self._recordings, episode.recording, episode.goal)
        goals = list(dict.fromkeys(one.goal for one in alike if one.goal != episode.goal))[:ALIKE]
        if not goals:
            return None
        return goals[int(np.random.default_rng(episode.seed).integers(len(goals)))]


def others(
    recordings: Sequence[Recording], exclude: Recording | None, goal: str
) -> list[Recording]:
    """The other episodes, those whose goals have the most words in common first."""
    words = set(goal.split())

    def unlike(recording: Recording) -> float:
        their = set(recording.goal.split())
        return 1 - len(words & their) / max(len(words | their), 1)

    return sorted((recording for recording in recordings if recording != exclude), key=unlike)


class ProbedPolicy(Policy):
    """`inner` under an arm. It evaluates and rolls out as any policy does, with the same noise."""

    def __init__(
        self,
        inner: Policy,
        arm: Arm = UNPROBED,
        sessions: Sequence[Recording] = (),
        donors: DonorEpisodes | None = None,
    ) -> None:
        """Wrap a policy.

        sessions: recorded episodes, of which as many as the arm needs are observed before each
            episode.
        donors: to take contents from.
        """
        super().__init__()
        self.inner, self.arm, self.donors = inner, arm, donors
        self.channel = channel_of(inner)
        self.feed = arm.feed
        self.sessions = list(sessions)[: self.feed.n_sessions]
        self.n_before = sum(recording.length for recording in self.sessions)
        """Frames of the sessions."""
        self.memory = inner.memory
        self.processor = inner.processor
        arm_config = {"probe": [arm.name, options_of(arm)]} if arm.parts else {}
        self.config = {**inner.config, **arm_config}
        self.horizon = inner.horizon
        self.info = PolicyInfo(
            sample_steps=inner.info.sample_steps,
            max_actions=inner.info.max_actions,
            max_running=inner.info.max_running,
            identity=inner.info.identity,
            server=inner.info.server,
            history_dtype=inner.info.history_dtype,
        )

    def start_episode(self, goal: str, seed: int = 0) -> ProbedEpisode:
        return ProbedEpisode(self, goal, seed)

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        return self.inner.sampling_noise(generator)

    def sample_actions(
        self, batch: Any, draws: Mapping[str, Tensor] | None = None, steps: int | None = None
    ) -> Tensor:
        return self.inner.sample_actions(batch, draws, steps)

    def vision_fingerprint(self) -> str:
        return self.inner.vision_fingerprint()

    def encode_frames(self, frames: np.ndarray) -> Tensor:
        return self.inner.encode_frames(frames)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """The episode's frames that the policy reads through the feed; None for all, where the feed
        leaves some out.
        """
        feed, n_before = self.feed, self.n_before
        if feed.drops or self.arm.shows:
            return None
        displayed = feed.displayed(steps, exec_start, n_before)
        reads = self.inner.frames_read(displayed, feed.first_executed(exec_start, n_before))
        if reads is None:
            return None
        if len(steps) and "choice" in self.arm.needs:
            # Which frames are left to choose from is known only then.
            stored = stored_frames(self.inner, int(displayed.max()) + 1)
            if stored is not None:
                reads = np.union1d(reads, stored)
        length = int(max(steps, default=-1)) + 1
        paused = np.flatnonzero(feed.repeats(np.arange(length), exec_start) > 1)
        return np.union1d(feed.source_frames(reads, exec_start, n_before), paused)

    def observation(self, episodes: Sequence[Episode]) -> Any:
        inner = []
        for episode in map(_probed, episodes):
            episode.show_collected()
            moment = self.moment(episode)
            episode.inner.goal = self.arm.instruct(episode.goal, moment)
            episode.inner.subgoal = self.arm.say(episode.subgoal, moment)
            inner.append(episode.inner)
        return self.inner.observation(inner)

    def predict_chunk(
        self,
        batch: Any,
        episodes: Sequence[Episode],
        draws: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        probed = [_probed(episode) for episode in episodes]
        if not self.arm.edits:
            inner = [episode.inner for episode in probed]
            return self.inner.predict_chunk(batch, inner, draws, steps)
        remembering = []
        for i, episode in enumerate(probed):
            sampled = {name: value[i] for name, value in draws.items()}
            snapshot, stores = self.snapshot(episode, sampled)
            remembering.append(self.channel.counterfactual(episode.inner, snapshot, stores))
        chunk = self.channel.predict_chunk(batch, remembering, draws, steps)
        for episode, memory in zip(probed, remembering, strict=True):
            self.channel.commit(episode.inner, memory)
        return chunk

    def snapshot(
        self, episode: ProbedEpisode, sampled: Noise | None = None
    ) -> tuple[MemorySnapshot, list[Remembered]]:
        """What is remembered among the frames that may be, and what the arm makes of it."""
        moment = self.moment(episode)
        snapshot = self.channel.read(episode.inner, only=self.arm.only(moment))
        edited = []
        for place, store in enumerate(snapshot.stores):
            weigh = None
            if sampled is not None:
                weigh = partial(self._weigh, episode, snapshot, place, sampled)
            # A moment of its own: the same chance for each store.
            edited.append(self.arm.edit(store, self.moment(episode, weigh)))
        return snapshot, edited

    def moment(self, episode: ProbedEpisode, weigh: Any = None) -> Moment:
        """What the arm may know now."""
        now = max(episode.inner.n_observed_frames - 1, 0)
        stored = np.zeros(0, np.int64)
        if self.memory is not None:
            stored = selectable(self.memory.storage).stored_frames(now + 1)
        rng = np.random.default_rng([episode.seed, now, zlib.crc32(self.arm.name.encode())])
        exec_start = episode.n_observed_frames
        if episode.exec_start is not None:
            exec_start = episode.exec_start
        known: dict[str, Any] = {"exec_start": exec_start}
        if self.donors is not None:
            donor = self.donors.of(episode)
            known |= {
                "donor": partial(donor.store, episode),
                "donor_subgoal": donor.subgoal_of(episode),
                "donor_recording": donor.recording,
                "donor_goal": self.donors.goal_for(episode),
            }
        subgoals = [*episode.subgoals, episode.subgoal]
        return Moment(rng, now, stored, episode.boundaries, subgoals, weigh=weigh, **known)

    def _weigh(
        self,
        episode: ProbedEpisode,
        snapshot: MemorySnapshot,
        place: int,
        sampled: Noise,
        store: Remembered,
    ) -> np.ndarray:
        """By how much a chunk changes without each slot of a store."""
        slots = store.occupied
        variants = []
        for candidate in [store, *(store.without([slot]) for slot in slots)]:
            variants.append([*snapshot.stores[:place], candidate, *snapshot.stores[place + 1 :]])
        chunks = self.ask(episode, snapshot, variants, [sampled])
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
        """Normalised chunks [variants, draws, h, w] as they are executed, adding nothing to the
        episode's memory.

        variants: what is remembered, store by store.
        draws: the random numbers that all variants share.
        batch: most chunks that are chosen at once.
        """
        memories: list[Any] = []
        noises: list[Noise] = []
        for variant in variants:
            memory = self.channel.counterfactual(episode.inner, snapshot, variant)
            memories += [memory] * len(draws)
            noises += draws
        chunks = []
        for start in range(0, len(memories), batch):
            part = memories[start : start + batch]
            observation = self.inner.observation([episode.inner] * len(part))
            stacked = stack_noise(noises[start : start + batch])
            chunk = self.channel.predict_chunk(observation, part, stacked, steps)
            require(
                bool(chunk.isfinite().all()),
                f"{self.arm.name}: a chunk is not finite. What reads the memory must also work"
                " where no token is left (`drop:all`): divide by mask.sum(1).clamp(min=1).",
            )
            chunks.append(chunk.float().cpu())
        action = self.embodiment.action
        stacked_chunks = torch.cat(chunks).unflatten(0, (len(variants), len(draws)))
        first = self.inner.require_processor().samples.window - 1
        return stacked_chunks[:, :, first : first + action.execute, : action.width]


def _probed(episode: Episode) -> ProbedEpisode:
    """An episode of a probed policy."""
    assert isinstance(episode, ProbedEpisode)
    return episode


def _show_all(recordings: Sequence[Recording], running: Episode, policy: Policy) -> None:
    """Show recorded episodes as if they were part of an episode's conditioning video."""
    before = sum(recording.length for recording in recordings)
    stored = stored_frames(policy, before)
    start = 0
    for recording in recordings:
        of_recording = None
        if stored is not None:
            of_recording = stored[stored >= start] - start
        recording.show(running, 0, recording.length, of_recording, video=True)
        start += recording.length
