"""The table of what the demonstrator solves over every dial: it is what was measured, and lacks no dial."""

import csv
import re
from collections import defaultdict

from conftest import REPOSITORY

from mme_vla.envs.variants import DIALS, SESSIONS


def test_the_table_of_dials_is_the_measured_one_and_has_every_dial_of_every_task() -> None:
    measured: dict[tuple[str, str], dict[int, list[bool]]] = defaultdict(lambda: defaultdict(list))
    with (REPOSITORY / "benchmarks" / "stress_dials.csv").open() as file:
        for row in csv.DictReader(file):
            measured[row["dial"], row["task"]][int(row["value"])].append(row["outcome"] == "success")
    assert set(measured) == {(dial, task) for dial, tasks in DIALS.items() for task in tasks}
    page = (REPOSITORY / "docs" / "benchmark.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if "| +0: " in line]
    shown, dial = {}, ""
    for name, _, task, solved in rows:
        dial = name.strip("`") or dial
        cells = re.findall(r"\+(\d+): (\d+)/(\d+)", solved)
        shown[dial, task] = {int(value): (int(won), int(of)) for value, won, of in cells}
    found = {pair: {at: (sum(won), len(won)) for at, won in values.items()} for pair, values in measured.items()}
    assert shown == found
    assert f"| `{SESSIONS}` |" in page
