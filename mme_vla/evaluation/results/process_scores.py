"""Where the chains of sub-tasks broke, task by task: at an operation of memory, at a motion, or for want of time."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from mme_vla.envs.process import MOTION, ProcessScore
from mme_vla.envs.subtasks import OPERATIONS
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import Method, Results
from mme_vla.evaluation.results.tables import Table

EXTRA = "process"
"""Where a record keeps it."""
CAPTION = (
    "Progress: sub-tasks done, of those there are. Then how many episodes ended by a wrong choice that is a mistake of "
    "memory (which one, where, how many, in what order, how), by another wrong one, or with the time run out."
)


def process_of(record: EpisodeRecord) -> ProcessScore | None:
    """What a record says of it; None for episodes whose environment did not tell.

    Raises:
        UserError: the score is damaged.
    """
    given = record.extra.get(EXTRA)
    return None if given is None else ProcessScore.from_dict(given)


def process_tables(results: Results) -> list[Table]:
    """A table of every method that has scores."""
    return [table for method in results.methods if (table := process_table(method, results))]


def process_table(method: Method, results: Results) -> Table | None:
    """Where the chains of one method broke, over all its runs; None without scores."""
    records = [record for run in method.runs for record in run.records.values() if EXTRA in record.extra]
    if not records:
        return None
    by_task = {task: [r for r in records if r.task == task] for task in results.protocol.tasks}
    rows = [_row(task, members) for task, members in by_task.items() if members]
    rows.append(_row("all", records))
    columns = ["", "episodes", "progress (%)", "success", *OPERATIONS, MOTION, "stuck"]
    return Table(f"{method.label}: where the chain broke", columns, rows, {len(rows) - 1}, {len(rows) - 1})


def _row(name: str, records: Sequence[EpisodeRecord]) -> list[str]:
    scores = [score for record in records if (score := process_of(record)) is not None]
    progress = 100 * np.mean([score.done / max(score.of, 1) for score in scores])
    ends = Counter(score.operation or score.broke or "success" for score in scores)
    counts = [ends[kind] for kind in ("success", *OPERATIONS, MOTION, "stuck")]
    return [name, str(len(scores)), f"{progress:.1f}", *("–" if not count else str(count) for count in counts)]
