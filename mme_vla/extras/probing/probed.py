"""A policy under an arm of a probe: its frames, its memory or its subgoal are changed, its weights
are not.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.extras.probing.arms import UNPROBED, Arm, options_of
from mme_vla.extras.probing.channels import Channel, MemorySnapshot, Remembered, channel_of
from mme_vla.extras.probing.feed import FedEpisode, FedPolicy
from mme_vla.extras.probing.interventions import Moment
from mme_vla.extras.probing.recordings import SUBGOAL, Recording, stored_frames
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.types import Noise, stack_noise


class ProbedEpisode(FedEpisode):
    """A fed episode that a probe follows.

    recording: the recorded episode, if it is one. subgoals: those that were set at each chunk so
    far.
    """

    recording: Recording | None = None

    def __init__(self, policy: "ProbedPolicy", goal: str, seed: int = 0) -> None:
        super().__init__(policy, goal, seed)
        self.subgoals: list[str | None] = []


ALIKE = 3  # episodes with the most similar goals among which a donor is chosen


class DonorEpisode:
    """A recorded episode that a policy has observed, from which contents are taken."""

    def __init__(self, policy: Policy, channel: Channel, recording: Recording) -> None:
        self._channel, self.recording = channel, recording
        self._subgoal_kind = subgoal_kind(policy) or SUBGOAL
        self._episode: Episode | None = None
        self._policy = policy

    def store_of(self, episode: ProbedEpisode) -> Callable[[str], Remembered]:
        """The store of a name, as many execution frames in as `episode` is; of banks, as it was in
        the end.
        """

        def store(name: str) -> Remembered:
            step = self._step(episode) if self._channel.chooses else None
            stores = {
                store.name: store for store in self._channel.read(self._observed(), step).stores
            }
            return stores[name]

        return store

    def subgoal_of(self, episode: ProbedEpisode) -> str | None:
        """The subgoal there, as many execution frames in."""
        if self._subgoal_kind not in self.recording.source.subgoal_names:
            return None
        return self.recording.subgoal(self._step(episode), self._subgoal_kind)

    def _step(self, episode: ProbedEpisode) -> int:
        executed = episode.n_observed_frames - 1 - (episode.exec_start or 0)
        return min(self.recording.exec_start + max(executed, 0), self.recording.length - 1)

    def _observed(self) -> Episode:
        if self._episode is None:
            recording, policy = self.recording, self._policy
            running, observed = policy.start_episode(recording.goal), 0
            # A bank is written where chunks are chosen; stored frames can be read at any step
            # afterwards.
            stops = (
                []
                if self._channel.chooses
                else recording.decisions(policy.embodiment.action.execute, None)
            )
            for stop in stops:
                recording.show(running, observed, stop + 1)
                observed = stop + 1
                running.subgoal = recording.subgoal(stop, self._subgoal_kind)
                policy.act([running])
            recording.show(
                running, observed, recording.length, stored_frames(policy, recording.length)
            )
            self._episode = running
        return self._episode


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


def others(
    recordings: Sequence[Recording], exclude: Recording | None, goal: str
) -> list[Recording]:
    """The other episodes, those whose goals have the most words in common first."""
    words = set(goal.split())

    def unlike(recording: Recording) -> float:
        their = set(recording.goal.split())
        return 1 - len(words & their) / max(len(words | their), 1)

    return sorted((recording for recording in recordings if recording != exclude), key=unlike)


class ProbedPolicy(FedPolicy):
    """`inner` under an arm."""

    def __init__(
        self,
        inner: Policy,
        arm: Arm = UNPROBED,
        sessions: Sequence[Recording] = (),
        donors: DonorEpisodes | None = None,
    ) -> None:
        """Wrap a policy.

        sessions: recorded episodes to observe before each, as many as the arm needs. donors: to
        take contents from.
        """
        super().__init__(inner, arm.feed, sessions)
        self.arm, self.channel, self.donors = arm, channel_of(inner), donors
        if arm.parts:
            self.config["probe"] = [arm.name, options_of(arm)]

    def start_episode(self, goal: str, seed: int = 0) -> ProbedEpisode:
        return ProbedEpisode(self, goal, seed)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        reads = super().frames_read(steps, exec_start)
        if reads is None or not len(steps) or "choice" not in self.arm.needs:
            return reads
        # Which frames are left to choose from is known only then.
        displayed = self.feed.displayed(steps, exec_start, self.before)
        stored = stored_frames(self.inner, int(displayed.max()) + 1)
        return (
            reads
            if stored is None
            else np.union1d(reads, self.feed.source_frames(stored, exec_start, self.before))
        )

    def observation(self, episodes: Sequence[Episode]) -> Any:
        for episode in map(_probed, episodes):
            episode.subgoals.append(episode.subgoal)
            episode.inner.subgoal = self.arm.say(episode.subgoal, self.moment(episode))
        return self.inner.observation([_probed(episode).inner for episode in episodes])

    def predict_chunk(
        self,
        batch: Any,
        episodes: Sequence[Episode],
        draws: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        if not self.arm.edits:
            return super().predict_chunk(batch, episodes, draws, steps)
        mine, remembering = [_probed(episode) for episode in episodes], []
        for i, episode in enumerate(mine):
            snapshot, stores = self.snapshot(
                episode, {name: value[i] for name, value in draws.items()}
            )
            remembering.append(self.channel.counterfactual(episode.inner, snapshot, stores))
        chunk = self.channel.predict_chunk(batch, remembering, draws, steps)
        for episode, its in zip(mine, remembering, strict=True):
            self.channel.commit(episode.inner, its)
        return chunk

    def snapshot(
        self, episode: ProbedEpisode, sampled: Noise | None = None
    ) -> tuple[MemorySnapshot, list[Remembered]]:
        """What is remembered among the frames that may be, and what the arm makes of it."""
        moment = self.moment(episode)
        snapshot = self.channel.read(episode.inner, only=self.arm.only(moment))
        edited = []
        for place, store in enumerate(snapshot.stores):
            weigh = (
                None if sampled is None else partial(self._weigh, episode, snapshot, place, sampled)
            )
            # the same chance for each store
            edited.append(self.arm.edit(store, self.moment(episode, weigh)))
        return snapshot, edited

    def moment(self, episode: ProbedEpisode, weigh: Any = None) -> Moment:
        """What the arm may know now."""
        now = max(episode.inner.n_observed_frames - 1, 0)
        stored = (
            np.zeros(0, np.int64)
            if self.memory is None
            else self.memory.storage.stored_frames(now + 1)
        )
        rng = np.random.default_rng([episode.seed, now, zlib.crc32(self.arm.name.encode())])
        known: dict[str, Any] = {}
        if self.donors is not None:
            donor = self.donors.of(episode)
            known = {"donor": donor.store_of(episode), "donor_subgoal": donor.subgoal_of(episode)}
        return Moment(rng, now, stored, episode.boundaries, episode.subgoals, weigh=weigh, **known)

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
        """Normalised chunks [variants, draws, h, w] as they are executed, adding nothing to the
        episode's memory.

        variants: what is remembered, store by store. draws: the random numbers that all variants
        share. batch: most chunks that are chosen at once.
        """
        chunks = []
        pairs = [(variant, sampled) for variant in variants for sampled in draws]
        ready = {
            id(variant): self.channel.counterfactual(episode.inner, snapshot, variant)
            for variant in variants
        }
        for start in range(0, len(pairs), batch):
            part = pairs[start : start + batch]
            observation = self.inner.observation([episode.inner] * len(part))
            stacked = stack_noise([sampled for _, sampled in part])
            chunks.append(
                self.channel.predict_chunk(
                    observation, [ready[id(v)] for v, _ in part], stacked, steps
                )
                .float()
                .cpu()
            )
        action = self.embodiment.action
        stacked_chunks = torch.cat(chunks).unflatten(0, (len(variants), len(draws)))
        first = self.inner.require_processor().samples.window - 1
        return stacked_chunks[:, :, first : first + action.execute, : action.width]


def _probed(episode: Episode) -> ProbedEpisode:
    """An episode of a probed policy."""
    assert isinstance(episode, ProbedEpisode)
    return episode
