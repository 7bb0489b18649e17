"""How long a run takes: a forecast from earlier records, and what a person sees of it
as it goes.
"""

import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from mme_vla.data.console import Bar
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError, counted, printable
from mme_vla.evaluation.records import EpisodeRecord, read_records
from mme_vla.evaluation.store import find_records


class RolloutProgress(Bar):
    """A line an episode, and the success so far: beside a bar on a terminal, else in the line.

    total: episodes of the run, whichever process runs them.
    before: records of those that an earlier run has finished.
    name: of the run, such as `nano · drop:all`: every line and the bar begin with it.
    """

    def __init__(
        self,
        total: int,
        before: Sequence[EpisodeRecord] = (),
        visible: bool = True,
        name: str = "",
    ) -> None:
        self._prefix = f"{printable(name)}: " if name else ""
        self._outcomes = Counter(record.outcome for record in before)
        super().__init__(total, self.done, self._prefix + self.summary, visible)

    @property
    def done(self) -> int:
        """Number of finished episodes."""
        return sum(self._outcomes.values())

    @property
    def summary(self) -> str:
        """The success so far, errors counting as failures."""
        success = self._outcomes["success"]
        errors = self._outcomes["error"]
        text = f"success {success}/{self.done}"
        if self.done:
            text += f" = {100 * success / self.done:.1f} %"
        if errors:
            text += f" · {errors} errors"
        return text

    def announce(self, folder: Path, forecast: str | None) -> None:
        """Say what the run's folder holds, and how long the rest takes."""
        if self.done:
            self.say(
                f"{folder} holds {self.done} of {counted(self.total, 'episode')}: continuing with"
                " the others"
            )
        if forecast is not None:
            self.say(forecast)

    def episode(self, record: EpisodeRecord, again: bool = False) -> None:
        """One episode ended; `again` if it will be tried once more, and does not count yet."""
        if not again:
            self._outcomes[record.outcome] += 1
            self.advance()
            self.describe(self._prefix + self.summary)
        seconds = record.seconds
        episode = f"{record.task} {record.episode}"
        if record.difficulty:
            episode += f" ({record.difficulty})"
        line = (
            f"{episode}: {record.outcome}, {counted(record.steps, 'step')} in"
            f" {seconds.total:.0f} s (simulation {seconds.sim:.0f},"
            f" rendering {seconds.render:.0f}, policy {seconds.policy:.0f})"
        )
        if record.error:
            line += f": {record.error}"
        if again:
            line += " · tried again"
        if self.bar is None:
            line += f" · {self.done}/{self.total}, {self.summary}"
        self.say(line)

    def say(self, text: str) -> None:
        """Print a line that stays."""
        super().say(f"{self._prefix}{text}")


def earlier_records(output: Path, named: Path | None) -> list[EpisodeRecord]:
    """Records without errors of a file or folder, by default of `output` and the
    folders beside it.
    """
    if named is not None:
        records = [record for path in find_records([named]) for record in read_records(path)]
    else:
        records = []
        for path in sorted(output.parent.glob("*/episodes*.jsonl")):
            # What is damaged, or being written, is another run's: its own command will say so.
            with suppress(UserError), warnings.catch_warnings(action="ignore"):
                records += read_records(path)
    return [record for record in records if record.outcome != "error"]


_Place = tuple[str | None, int | None]


def _places(episode: Job | EpisodeRecord) -> tuple[_Place, ...]:
    """What an episode's time is looked up under, the nearest first: itself, its task, anything."""
    return (episode.task, episode.episode), (episode.task, None), (None, None)


class Durations:
    """Seconds of an episode: in its environment, and the policy's for it."""

    def __init__(self, records: Iterable[EpisodeRecord]) -> None:
        self.records = list(records)
        self._means: dict[_Place, tuple[float, float]] = {}
        groups: dict[_Place, list[EpisodeRecord]] = {}
        for record in self.records:
            for place in _places(record):
                groups.setdefault(place, []).append(record)
        for place, members in groups.items():
            environment = sum(r.seconds.sim + r.seconds.render for r in members) / len(members)
            self._means[place] = environment, sum(r.seconds.policy for r in members) / len(members)

    def of(self, job: Job) -> tuple[float, float]:
        """(environment, policy): of the episode itself, else the mean of its task, else of all; 0
        without records.
        """
        for place in _places(job):
            if place in self._means:
                return self._means[place]
        return 0.0, 0.0

    def longest_first(self, jobs: Sequence[Job]) -> list[Job]:
        """The jobs, those that took longest first; in their own order without records."""
        return sorted(jobs, key=lambda job: -sum(self.of(job)))

    def forecast(self, jobs: Sequence[Job], workers: int, processes: int = 1) -> str | None:
        """How long running the jobs will take, in a sentence; None without records.

        Environments run side by side while the policy acts: the slower of the two decides, and the
        longest episode is waited for in any case.

        workers: environments at a time in a process.
        processes: that share the run.
        """
        if not self.records or not jobs:
            return None
        each = [self.of(job) for job in jobs]
        environment, policy = (sum(column) for column in zip(*each, strict=True))
        seconds = max(environment / workers, policy, max(map(sum, each)) * processes) / processes
        time = "a minute at most"
        if seconds >= 3600:
            time = f"{seconds / 3600:.1f} h"
        elif seconds >= 60:
            time = f"{seconds / 60:.0f} min"
        return (
            f"forecast: about {time} for {counted(len(jobs), 'episode')}, {workers * processes} at"
            f" a time, if they take as long as the {len(self.records):,} before them did"
        )
