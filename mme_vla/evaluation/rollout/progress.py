"""What a person sees of a running evaluation: a bar with the success so far, and a line for every episode."""

from collections import Counter
from collections.abc import Sequence
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mme_vla.evaluation.records import EpisodeRecord


class RolloutProgress:
    """A bar on a terminal; anywhere else the lines alone. A context manager.

    Args:
        total: episodes of this process. before: records of those that an earlier run has finished.
    """

    def __init__(self, total: int, before: Sequence[EpisodeRecord] = (), visible: bool = True) -> None:
        self.console = Console(quiet=not visible, highlight=False, soft_wrap=True, stderr=True)
        self.total, self._outcomes = total, Counter(record.outcome for record in before)
        self._bar: Progress | None = None
        if self.console.is_terminal and visible:
            clock = (TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())
            columns = (BarColumn(24), MofNCompleteColumn(), TextColumn("{task.description}"), *clock)
            self._bar = Progress(*columns, console=self.console)
            self._task = self._bar.add_task(self.summary, total=total, completed=self.done)

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    @property
    def done(self) -> int:
        """Episodes that are finished, for good or ill."""
        return sum(self._outcomes.values())

    @property
    def summary(self) -> str:
        """The success so far, errors counting as failures."""
        success, errors = self._outcomes["success"], self._outcomes["error"]
        text = f"success {success}/{self.done}" + (f" = {100 * success / self.done:.1f} %" if self.done else "")
        return f"{text} · {errors} errors" if errors else text

    def episode(self, record: EpisodeRecord, again: bool = False) -> None:
        """One episode ended; `again` if it will be tried once more, and does not count yet."""
        if not again:
            self._outcomes[record.outcome] += 1
        seconds = record.seconds
        line = (
            f"{record.task} {record.episode} ({record.difficulty}): {record.outcome}, {record.steps} steps in "
            f"{seconds.total:.0f} s (simulation {seconds.sim:.0f}, rendering {seconds.render:.0f}, "
            f"policy {seconds.policy:.0f})"
        )
        line += f": {record.error}" if record.error else ""
        line += " · tried again" if again else ""
        if self._bar is not None:
            self._bar.update(self._task, description=self.summary, completed=self.done)
            self._bar.console.print(line, markup=False)
        else:
            self.console.print(f"{line} · {self.done}/{self.total}, {self.summary}", markup=False)

    def say(self, text: str) -> None:
        """Print a line that stays."""
        self.console.print(text, markup=False)
