"""A sample of `benchmarks/kill.py`: a conversion killed at some of its changes of files ends as one that was not."""

import json
from pathlib import Path

import pytest

from helpers import commands


@pytest.mark.slow
def test_a_killed_conversion_ends_as_an_undisturbed_one(tmp_path: Path) -> None:
    report = tmp_path / "killed.json"
    words = ["benchmarks/kill.py", "convert", "--first=4", "--every=4000", f"--json={report}"]
    done = commands.run(*words, timeout=300)
    if "no filter of system calls" in done.stderr or "Operation not permitted" in done.stderr:
        pytest.skip("this system does not let processes be traced")
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    (outcome,) = json.loads(report.read_text())
    assert outcome["kills"] >= 2
    assert outcome["left"] == 0
