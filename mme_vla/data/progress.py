"""The progress bar of this room's long commands."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress(description: str, total: int, done: int = 0, unit: str = "") -> Iterator[Callable[[int], None]]:
    """Show a bar of `total` steps, `done` of them finished before; the yielded function advances it."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
    with Progress(*columns, TimeRemainingColumn()) as bar:
        task = bar.add_task(description, total=total, completed=done)

        def advance(steps: int) -> None:
            bar.advance(task, steps)

        yield advance
