"""Other episodes that contents and words are taken from, each run once."""

from collections.abc import Callable, Sequence

import numpy as np

from mme_vla.evaluation.probe.channels import Channel
from mme_vla.evaluation.probe.probed_episode import ProbedEpisode
from mme_vla.evaluation.probe.recordings import SUBGOAL, Recording, others, stored_frames
from mme_vla.evaluation.probe.remembered import Remembered
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.processing.subgoal_text import subgoal_kind

ALIKE = 3  # of the other episodes, so many with the most similar goals lend


class Lent:
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
            found = {store.name: store for store in self._channel.read(self._seen(), step).stores}
            return found[name]

        return store

    def said_of(self, episode: ProbedEpisode) -> str | None:
        """What was said there, as many execution frames in."""
        if self._said not in self.recording.source.subgoal_names:
            return None
        return self.recording.subgoal(self._step(episode), self._said)

    def _step(self, episode: ProbedEpisode) -> int:
        executed = episode.frames_seen - 1 - (episode.exec_start or 0)
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


class Lenders:
    """Who lends to whom: for each episode always the same, one of those whose goals are most alike."""

    def __init__(self, policy: Policy, channel: Channel, recordings: Sequence[Recording]) -> None:
        self._policy, self._channel, self._recordings = policy, channel, list(recordings)
        self._lent: dict[str, Lent] = {}

    def of(self, episode: ProbedEpisode) -> Lent:
        """Who lends to this episode."""
        alike = others(self._recordings, episode.recording, episode.goal)[:ALIKE]
        chosen = alike[int(np.random.default_rng(episode.seed).integers(len(alike)))]
        if chosen.name not in self._lent:
            self._lent[chosen.name] = Lent(self._policy, self._channel, chosen)
        return self._lent[chosen.name]
