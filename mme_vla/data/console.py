"""The progress of the long commands of this package: a bar on a terminal, a line now and then
anywhere else.
"""

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial, partialmethod


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
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    if total == 1:
        unit = unit.removesuffix("s")
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    if not (console.is_terminal and console.file.isatty()):
        # FORCE_COLOR makes the first true, in notebooks too
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
            console.print(f"{description}: {counted} in {_duration_text(now - begun)}{remaining}")

        yield count_up
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(unit),
    )
    with Progress(*columns, TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task(description, total=total, completed=done)

        yield partial(bar.advance, task)


def _duration_text(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
