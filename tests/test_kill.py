"""A sample of `benchmarks/kill.py`: a conversion killed at some of its changes of files ends as one that was not."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


def test_a_killed_conversion_ends_as_an_undisturbed_one(tmp_path: Path) -> None:
    report = tmp_path / "killed.json"
    command = [sys.executable, "benchmarks/kill.py", "convert", "--first=4", "--every=4000", f"--json={report}"]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=300)
    if "no filter of system calls" in done.stderr or "Operation not permitted" in done.stderr:
        pytest.skip("this system does not let processes be traced")
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    (outcome,) = json.loads(report.read_text())
    assert outcome["kills"] >= 2
    assert outcome["left"] == 0
