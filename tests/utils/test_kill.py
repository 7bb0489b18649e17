"""A sample of `benchmarks/kill.py`: a conversion that is killed and repeated ends as an undisturbed
one.
"""

import json
from pathlib import Path

import pytest

from helpers import commands


@pytest.mark.nightly
def test_a_killed_conversion_ends_as_an_undisturbed_one(tmp_path: Path) -> None:
    report = tmp_path / "killed.json"
    words = ["benchmarks/kill.py", "convert", "--every=60", "--times=1", f"--json={report}"]
    done = commands.run(*words)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    (outcome,) = json.loads(report.read_text())
    assert outcome["kills"] >= 2 and outcome["changes"] > 20
    assert outcome["left"] == 0
