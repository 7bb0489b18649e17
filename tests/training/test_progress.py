"""What long commands say where no terminal is, and what they say of memory."""

from rich.text import Text

from mme_vla.data import console as module
from mme_vla.data.console import progress


def test_without_a_terminal_a_line_now_and_then_says_what_is_done_and_what_is_left(
    monkeypatch, capsys
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # as in notebooks: colours, and still no terminal
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with progress("record", total=1000, done=600, unit="episodes") as advance:
        for _ in range(400):
            now[0] += 1.0
            advance(1)
    lines = Text.from_ansi(capsys.readouterr().err).plain.splitlines()
    assert len(lines) == 400 / module.LINE_SECONDS
    assert lines[0] == "record: 620 of 1,000 episodes in 20 s, about 6 min left"
    assert lines[-1] == "record: 1,000 of 1,000 episodes in 7 min"


def test_time_left_does_not_count_what_comes_before_the_first_step(monkeypatch, capsys) -> None:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with progress("record", total=1000) as advance:
        for seconds, steps in (
            (19.0, 500),
            (1.0, 10),
        ):  # start-up and those of an interrupted run, new ones
            now[0] += seconds
            advance(steps)
    line = Text.from_ansi(capsys.readouterr().err).plain.splitlines()[0]
    assert line == "record: 510 of 1,000 in 20 s, about 49 s left"


def test_a_single_step_is_named_in_the_singular(capsys) -> None:
    with progress("show", total=1, unit="tasks") as advance:
        advance(1)
    assert Text.from_ansi(capsys.readouterr().err).plain.startswith("show: 1 of 1 task in")
