"""The progress of the long commands of this package: a bar on a terminal, a line now and then
anywhere else.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partialmethod
from typing import Self


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Surround work whose progress this library shows itself.

    Log records below warnings are dropped, and no bars but this library's appear.
    """
    import av.logging
    import tqdm
    from lerobot.utils.utils import SuppressProgressBars

    root = logging.getLogger()  # LeRobot reports by it
    level = root.level
    begin = tqdm.tqdm.__init__
    root.setLevel(max(level, logging.WARNING))
    tqdm.tqdm.__init__ = partialmethod(begin, disable=True)
    # x264 sums up every video that it closes. LeRobot asks for warnings only, but not until then.
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        with SuppressProgressBars():
            yield
    finally:
        av.logging.set_libav_level(av.logging.INFO)  # FFmpeg's own default
        tqdm.tqdm.__init__ = begin
        root.setLevel(level)


LINE_SECONDS = 20.0
"""Without a terminal: how long a log stays silent at most while steps are being finished."""


class Bar:
    """A bar on a terminal, with a text beside it that changes; anywhere else only lines. A context
    manager.

    total, done: steps, and those of them that were finished before.
    visible: False prints nothing.
    stderr: where it is printed; False for stdout.
    """

    def __init__(
        self, total: int, done: int = 0, text: str = "", visible: bool = True, stderr: bool = True
    ) -> None:
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        self.total = total
        self.visible = visible
        self.console = Console(quiet=not visible, highlight=False, soft_wrap=True, stderr=stderr)
        self.bar: Progress | None = None
        # FORCE_COLOR makes the first true, in notebooks too
        if self.console.is_terminal and self.console.file.isatty() and visible:
            columns = (
                BarColumn(24),
                MofNCompleteColumn(),
                TextColumn("{task.description}", markup=False),
                TimeRemainingColumn(),
            )
            self.bar = Progress(*columns, console=self.console)
            self._task = self.bar.add_task(text, total=total, completed=done)

    def __enter__(self) -> Self:
        if self.bar is not None:
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()

    def advance(self, steps: int = 1) -> None:
        """Count finished steps."""
        if self.bar is not None:
            self.bar.advance(self._task, steps)

    def describe(self, text: str) -> None:
        """Replace the text beside the bar; without a terminal, nothing."""
        if self.bar is not None:
            self.bar.update(self._task, description=text)

    def say(self, text: str) -> None:
        """Print a line that stays."""
        self.console.print(text, markup=False)


@contextmanager
def progress(
    description: str, total: int, done: int = 0, unit: str = ""
) -> Iterator[Callable[[int], None]]:
    """Show a bar of `total` steps, `done` of them finished before; the yielded function advances
    it.

    unit: what a step is, in the plural.

    Where no terminal is, a line says what is finished: at most one every `LINE_SECONDS`, and one
    after the last step.
    """
    if total == 1:
        unit = unit.removesuffix("s")
    with Bar(total, done, f"{unit} · {description}" if unit else description) as bar:
        if bar.bar is not None:
            yield bar.advance
            return
        begun = reported = time.monotonic()
        count = done
        # Time and count after the first steps, which also took what was needed to start.
        first: tuple[float, int] | None = None

        def count_up(steps: int) -> None:
            nonlocal reported, count, first
            count += steps
            now = time.monotonic()
            first = first or (now, count)
            if count < total and now - reported < LINE_SECONDS:
                return
            reported = now
            remaining = ""
            n_new = count - first[1]
            if n_new and count < total:
                seconds = (now - first[0]) / n_new * (total - count)
                remaining = f", about {_duration_text(seconds)} left"
            counted = f"{count:,} of {total:,} {unit}".rstrip()
            bar.say(f"{description}: {counted} in {_duration_text(now - begun)}{remaining}")

        yield count_up


def _duration_text(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
