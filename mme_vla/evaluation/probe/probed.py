"""A policy under an arm of a probe: it is shown, remembers or is told something else, and is itself untouched."""

import zlib
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.backbone.base import Draws, stack_draws
from mme_vla.evaluation.probe.arms import UNPROBED, Arm, options_of
from mme_vla.evaluation.probe.channels import Recollection, channel_of
from mme_vla.evaluation.probe.interventions import Moment
from mme_vla.evaluation.probe.lending import Lenders
from mme_vla.evaluation.probe.probed_episode import ProbedEpisode
from mme_vla.evaluation.probe.recordings import Recording, stored_frames
from mme_vla.evaluation.probe.remembered import Remembered
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode


class ProbedPolicy(Policy):
    """`inner` under an arm. It evaluates and rolls out as any policy does; its noise is that of the unprobed one."""

    def __init__(
        self,
        inner: Policy,
        arm: Arm = UNPROBED,
        sessions: Sequence[Recording] = (),
        lenders: Lenders | None = None,
        of_split: bool = False,
    ) -> None:
        """Stand before a policy.

        Args:
            sessions: what is shown before each episode, as far as the arm asks for it.
            lenders: other episodes to take from. of_split: the sessions are those of a stress split.
        """
        super().__init__()
        self.inner, self.arm, self.channel = inner, arm, channel_of(inner)
        self.memory, self.processor = inner.memory, inner.processor
        self.config = {**inner.config, **({"probe": [arm.name, options_of(arm)]} if arm.parts else {})}
        self.history_dtype, self.horizon, self.skipped = inner.history_dtype, inner.horizon, inner.skipped
        self.sample_steps, self.action_dim = inner.sample_steps, inner.action_dim
        self.most_actions = inner.most_actions
        self.sessions, self.lenders = list(sessions)[: arm.feed.sessions], lenders
        self.sessions_before = len(self.sessions) if of_split else 0  # those of an arm are the probe's own

    @property
    def before(self) -> int:
        """Frames of the sessions."""
        return sum(recording.length for recording in self.sessions)

    def start_episode(self, goal: str, seed: int = 0) -> ProbedEpisode:
        """Begin an episode, with the sessions that come before it."""
        return ProbedEpisode(self, goal, seed)

    def sample_draws(self, generator: torch.Generator) -> Draws:
        return self.inner.sample_draws(generator)

    def sample_actions(self, batch: Any, draws: Mapping[str, Tensor] | None = None, steps: int | None = None) -> Tensor:
        return self.inner.sample_actions(batch, draws, steps)

    def encode_frames(self, frames: np.ndarray) -> Tensor:
        return self.inner.encode_frames(frames)

    def vision_fingerprint(self) -> str:
        return self.inner.vision_fingerprint()

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """The episode's own frames that are looked at, through what the arm makes of them."""
        feed, before = self.arm.feed, self.before
        shown = feed.shown(steps, exec_start, before)
        reads = self.inner.frames_read(shown, feed.first_executed(exec_start, before))
        if reads is None:
            return None
        if "choice" in self.arm.needs and len(shown):  # which frames are left to choose from, only then is known
            stored = stored_frames(self.inner, int(shown.max()) + 1)
            reads = reads if stored is None else np.union1d(reads, stored)
        held = [exec_start + feed.at] if feed.stills else []
        return np.union1d(feed.own(reads, exec_start, before), np.array(held, np.int64))

    def observation(self, episodes: Sequence[Episode]) -> Any:
        for episode in map(own, episodes):
            episode.said.append(episode.subgoal)
            episode.told(self.arm.say(episode.subgoal, self.moment(episode)))
        return self.inner.observation([own(episode).inner for episode in episodes])

    def answer(
        self, batch: Any, episodes: Sequence[Episode], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        mine = [own(episode) for episode in episodes]
        if not self.arm.edits:
            return self.inner.answer(batch, [episode.inner for episode in mine], draws, steps)
        remembering = []
        for i, episode in enumerate(mine):
            drawn = {name: value[i] for name, value in draws.items()}
            recollection, stores = self.recall(episode, drawn)
            remembering.append(self.channel.as_if(episode.inner, recollection, stores))
        chunk = self.channel.answer(batch, remembering, draws, steps)
        for episode, its in zip(mine, remembering, strict=True):
            self.channel.chosen(episode.inner, its)
        return chunk

    def recall(self, episode: ProbedEpisode, drawn: Draws | None = None) -> tuple[Recollection, list[Remembered]]:
        """What is remembered among the frames that may be, and what the arm makes of it."""
        moment = self.moment(episode)
        recollection = self.channel.read(episode.inner, only=self.arm.only(moment))
        edited = []
        for place, store in enumerate(recollection.stores):
            weigh = None if drawn is None else partial(self._weigh, episode, recollection, place, drawn)
            edited.append(self.arm.edit(store, self.moment(episode, weigh)))  # the same chance for each store
        return recollection, edited

    def moment(self, episode: ProbedEpisode, weigh: Any = None) -> Moment:
        """What the arm may know now."""
        now = max(episode.inner.frames_seen - 1, 0)
        kept = np.zeros(0, np.int64) if self.memory is None else self.memory.storage.kept_frames(now + 1)
        rng = np.random.default_rng([episode.seed, now, zlib.crc32(self.arm.name.encode())])
        known: dict[str, Any] = {}
        if self.lenders is not None:
            lent = self.lenders.of(episode)
            known = {"donor": lent.store_of(episode), "donor_said": lent.said_of(episode)}
        return Moment(rng, now, kept, episode.boundaries, episode.said, weigh=weigh, **known)

    def _weigh(
        self, episode: ProbedEpisode, recollection: Recollection, place: int, drawn: Draws, store: Remembered
    ) -> np.ndarray:
        """By how much a chunk changes without each slot of a store."""
        held = store.held
        variants = [store, *(store.without([slot]) for slot in held)]
        stores = [[*recollection.stores[:place], v, *recollection.stores[place + 1 :]] for v in variants]
        chunks = self.ask(episode, recollection, stores, [drawn])
        changes = np.zeros(len(store))
        changes[held] = (chunks[1:, 0] - chunks[0, 0]).square().mean((1, 2)).sqrt().numpy()
        return changes

    @torch.no_grad()
    def ask(
        self,
        episode: ProbedEpisode,
        recollection: Recollection,
        variants: Sequence[Sequence[Remembered]],
        draws: Sequence[Draws],
        steps: int | None = None,
        batch: int = 64,
    ) -> Tensor:
        """Normalised chunks [variants, draws, h, w] as they are executed, adding nothing to the episode's memory.

        Args:
            variants: what is remembered, store by store. draws: the random numbers that all variants share.
            batch: most chunks that are chosen at once.
        """
        found = []
        pairs = [(variant, drawn) for variant in variants for drawn in draws]
        ready = {id(variant): self.channel.as_if(episode.inner, recollection, variant) for variant in variants}
        for start in range(0, len(pairs), batch):
            part = pairs[start : start + batch]
            seen = self.inner.observation([episode.inner] * len(part))
            stacked = stack_draws([drawn for _, drawn in part])
            found.append(self.channel.answer(seen, [ready[id(v)] for v, _ in part], stacked, steps).float().cpu())
        action = self.embodiment.action
        whole = torch.cat(found).unflatten(0, (len(variants), len(draws)))
        return whole[:, :, self.skipped : self.skipped + action.execute, : action.width]


def own(episode: Episode) -> ProbedEpisode:
    """An episode of a probed policy."""
    assert isinstance(episode, ProbedEpisode)
    return episode
