"""A probe on recorded episodes: how the chunk that a policy would choose changes with what it
remembers.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mme_vla.evaluation.rollout.running import episode_seed
from mme_vla.extras.probing import lines
from mme_vla.extras.probing.arms import UNPROBED, Arm
from mme_vla.extras.probing.channels import MemorySnapshot
from mme_vla.extras.probing.feed import Feed
from mme_vla.extras.probing.lines import EntryLine, Line, MomentLine
from mme_vla.extras.probing.probed import DonorEpisodes, ProbedEpisode, ProbedPolicy, others
from mme_vla.extras.probing.recordings import Recording
from mme_vla.extras.probing.settings import OfflineSettings
from mme_vla.policy.base import Policy
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.types import Noise
from mme_vla.utils import FolderLock


@dataclass(frozen=True)
class Change:
    """What became of a chunk, in normalised actions (1: half of what the training data span), root
    mean square.

    change: mean distance of two chunks of the same noise.
    spread: mean distance of two chunks that differ in noise alone, unprobed.
    distance: energy distance of the two distributions, 0 where they are one.
    """

    change: float
    spread: float
    distance: float


def compare_chunks(before: Tensor, after: Tensor) -> Change:
    """Compare chunks [n, h, w] before and after an intervention, row by row of the same noise."""
    first = before.double().flatten(1).numpy()
    second = after.double().flatten(1).numpy()
    across = _distances(first, second)
    within = _distances(first, first)
    n = len(within)
    spread = float(within.sum() / (n * (n - 1))) if n > 1 else 0.0  # between different rows
    energy = 2 * across.mean() - within.mean() - _distances(second, second).mean()
    return Change(float(np.diagonal(across).mean()), spread, float(max(energy, 0.0)))


def _distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.sqrt(np.square(first[:, None] - second[None]).mean(-1))


def probe_offline(
    policy: Policy,
    arms: Sequence[Arm],
    recordings: Sequence[Recording],
    lend: Sequence[Recording],
    path: Path,
    settings: OfflineSettings,
    after: Callable[[int], None] = lambda count: None,
) -> list[Line]:
    """Probe every recorded episode that the file holds no lines of yet; all its lines, old and new.

    recordings: episodes to probe.
    lend: episodes to take from, the same or others.
    path: of the lines.
    after: called after each episode with 1.
    """
    donors = DonorEpisodes(policy, ProbedPolicy(policy).channel, lend) if len(lend) > 1 else None
    with FolderLock(path.parent, "probe", f".{path.stem}.lock"):
        _, done = lines.read(path)
        for recording in recordings:
            if recording.name not in done:
                result = _Moments(policy, arms, recording, lend, donors, settings).lines()
                lines.append(path, result, recording.name)
            after(1)
        return lines.read(path)[0]


class _Moments:
    """One recorded episode under all arms."""

    def __init__(
        self,
        policy: Policy,
        arms: Sequence[Arm],
        recording: Recording,
        lend: Sequence[Recording],
        donors: DonorEpisodes | None,
        settings: OfflineSettings,
    ) -> None:
        self._policy, self._recording, self._settings = policy, recording, settings
        self._seed = episode_seed(settings.seed, recording.task, recording.episode)
        self._steps = recording.decisions(policy.embodiment.action.execute, settings.moments)
        self._decisions = recording.decisions(policy.embodiment.action.execute, None)
        self._subgoal_kind = subgoal_kind(policy)
        self._boundaries = recording.boundaries()
        sessions = others(lend, recording, recording.goal)
        self._by_feed: dict[Feed, list[ProbedPolicy]] = defaultdict(list)
        for arm in [UNPROBED, *arms]:
            self._by_feed[arm.feed].append(ProbedPolicy(policy, arm, sessions, donors).eval())
        # Of each step, the noise that all arms share
        generator = torch.Generator().manual_seed(self._seed)
        self._draws: dict[int, list[Noise]] = {step: [] for step in self._steps}
        for noise_of_step in self._draws.values():
            for _ in range(settings.draws):
                noise_of_step.append(policy.sampling_noise(generator))
        self._baseline: dict[int, Tensor] = {}  # Unprobed chunks [draws, h, w] of each step

    def lines(self) -> list[Line]:
        """All lines: the episode runs once for all arms with the same feed."""
        result: list[Line] = []
        recording = self._recording
        for arms in self._by_feed.values():
            episode = arms[0].start_episode(recording.goal, self._seed)
            episode.recording = recording
            # Where no frames are chosen from, a memory is written where chunks are chosen: at each
            # decision, as in a running episode.
            steps = self._steps if arms[0].channel.chooses else self._decisions
            required = self._required_frames(arms, steps)
            n_observed = 0
            for step in self._decisions:
                if self._subgoal_kind is not None:
                    episode.subgoal = recording.subgoal(step, self._subgoal_kind)
                if step in steps:
                    recording.show(episode, n_observed, step + 1, required)
                    n_observed = step + 1
                    boundaries = np.array(sorted(self._boundaries), np.int64)
                    episode.boundaries = episode.numbers(boundaries)
                    if step in self._steps:
                        for probed in arms:
                            result += self._probe(probed, episode, step)
                    episode.inner.subgoal = episode.subgoal
                    self._policy.act([episode.inner], self._settings.flow_steps)
                episode.subgoals.append(episode.subgoal)
        return result

    def _probe(self, probed: ProbedPolicy, episode: ProbedEpisode, step: int) -> list[Line]:
        """The effect of an arm at a step; of the unprobed one, the baseline."""
        arm, draws, steps = probed.arm, self._draws[step], self._settings.flow_steps
        episode.inner.subgoal = arm.say(episode.subgoal, probed.moment(episode))
        snapshot, edited = probed.snapshot(episode, draws[0])
        if arm is UNPROBED:
            self._baseline[step] = probed.ask(episode, snapshot, [edited], draws, steps)[0]
            return self._scan(probed, episode, snapshot, step) if self._settings.scan else []
        chunks = probed.ask(episode, snapshot, [edited], draws, steps)[0]
        change = compare_chunks(self._baseline[step], chunks)
        touched: list[int] = []
        for old, new in zip(snapshot.stores, edited, strict=True):
            touched += old.changed(new)
        return [
            MomentLine(
                self._recording.name,
                self._recording.task,
                step,
                self._phase(step),
                self._recording.subgoal(step) or "",
                arm.name,
                arm.dial(),
                sum(map(len, snapshot.stores)),
                touched,
                **asdict(change),
            )
        ]

    def _scan(
        self, probed: ProbedPolicy, episode: ProbedEpisode, snapshot: MemorySnapshot, step: int
    ) -> list[Line]:
        """The change that each entry's absence makes, one at a time."""
        stores = snapshot.stores
        places = []
        variants = []
        for i, store in enumerate(stores):
            for slot in store.occupied:
                places.append((i, slot))
                variants.append([*stores[:i], store.without([slot]), *stores[i + 1 :]])
        if not places:
            return []
        chunks = probed.ask(
            episode, snapshot, variants, self._draws[step], self._settings.flow_steps
        )
        result: list[Line] = []
        for (i, slot), chunk in zip(places, chunks, strict=True):
            change = compare_chunks(self._baseline[step], chunk)
            entry = stores[i].entries[slot]
            assert entry is not None
            result.append(
                EntryLine(
                    self._recording.name,
                    self._recording.task,
                    step,
                    self._phase(step),
                    stores[i].name,
                    slot,
                    entry.time,
                    stores[i].age(slot),
                    entry.time < self._recording.exec_start,
                    change.change,
                    change.spread,
                )
            )
        return result

    def _phase(self, step: int) -> int:
        """Sub-tasks of the execution that began before this step's."""
        return sum(self._recording.exec_start < frame <= step for frame in self._boundaries)

    def _required_frames(
        self, arms: Sequence[ProbedPolicy], steps: Sequence[int]
    ) -> np.ndarray | None:
        """Frames that any of these arms reads at these steps; None for all."""
        required: np.ndarray = np.zeros(0, np.int64)
        for probed in arms:
            frames = probed.frames_read(np.array(steps), self._recording.exec_start)
            if frames is None:
                return None
            required = np.union1d(required, frames)
        return required
