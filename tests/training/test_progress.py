"""What long commands say where no terminal is, and what they say of memory."""

import subprocess
import sys

import numpy as np
import pytest

from mme_vla.data import console as module
from mme_vla.data.console import progress
from mme_vla.training.logging import resident_gib


def test_without_a_terminal_a_line_now_and_then_says_what_is_done_and_what_is_left(monkeypatch, capsys) -> None:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with progress("record", total=1000, done=600, unit="episodes") as advance:
        for _ in range(400):
            now[0] += 1.0
            advance(1)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 400 / module.LINE_SECONDS
    assert lines[0] == "record: 620 of 1,000 episodes in 20 s, about 6 min left"
    assert lines[-1] == "record: 1,000 of 1,000 episodes in 7 min"


@pytest.mark.parametrize("total", [0, 3])
def test_nothing_to_do_says_nothing(capsys, total: int) -> None:
    with progress("convert", total, done=total):
        pass
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_the_memory_of_a_run_excludes_that_of_its_parent_process() -> None:
    ballast = np.ones(60_000_000)  # 460 MiB, which a child's getrusage would begin with
    code = "from mme_vla.training.logging import resident_gib; print(resident_gib())"
    alone = float(subprocess.check_output([sys.executable, "-c", code]))
    assert 0 < alone < resident_gib() - 0.3
    del ballast
