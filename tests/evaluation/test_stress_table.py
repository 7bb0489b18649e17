"""The table of what demonstrator and oracle solve over every dial: it is what was measured, and lacks no dial."""

import csv
import re
from collections import defaultdict

from helpers import REPOSITORY
from mme_vla.envs.metadata import DIALS, SESSIONS

ACTORS = ("demonstrator", "oracle")


def test_the_table_of_dials_is_the_measured_one_and_has_every_dial_of_every_task() -> None:
    measured: dict[tuple[str, str, str], dict[int, list[bool]]] = defaultdict(lambda: defaultdict(list))
    with (REPOSITORY / "benchmarks" / "stress_dials.csv").open() as file:
        for row in csv.DictReader(file):
            won = row["outcome"] == "success"
            measured[row["actor"], row["dial"], row["task"]][int(row["value"])].append(won)
    dials = {(dial, task) for dial, tasks in DIALS.items() for task in tasks}
    assert set(measured) == {(actor, *pair) for actor in ACTORS for pair in dials}
    page = (REPOSITORY / "docs" / "evidence" / "benchmark.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if "| +0: " in line]
    table, dial = {}, ""
    for name, _, task, *solved in rows:
        dial = name.strip("`") or dial
        for actor, rate in zip(ACTORS, solved, strict=True):
            cells = re.findall(r"\+(\d+): (\d+)/(\d+)", rate)
            table[actor, dial, task] = {int(value): (int(won), int(of)) for value, won, of in cells}
    rates = {key: {at: (sum(won), len(won)) for at, won in values.items()} for key, values in measured.items()}
    assert table == rates
    assert f"| `{SESSIONS}` |" in page
