"""Episodes that processes share: each taken once, the longest first, and again after a process was
killed.
"""

import errno
import fcntl
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation import claims as claims_file
from mme_vla.evaluation.claims import Claims, Waiting, check_sharing
from mme_vla.evaluation.records import EpisodeRecord, RecordLog, Seconds
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.compare import compare
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.rollout.progress import Durations
from mme_vla.utils import write_json

JOBS = [Job("BinFill", "test", i) for i in range(4)]

TAKE_TWO = """
import sys
from pathlib import Path
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.claims import Claims
from mme_vla.evaluation.records import RecordLog
from mme_vla.evaluation.records import EpisodeRecord
folder = Path(sys.argv[1])
log = RecordLog(folder / "episodes-0of2.jsonl")
claims, jobs = Claims(folder, "episodes-0of2.jsonl"), [Job("BinFill", "test", i) for i in range(4)]
first = claims.take(jobs)
log.append(EpisodeRecord("tiny", 1, 7, first.task, first.episode, 1, "easy", "success", 5))
claims.take(jobs[1:])
print("taken", flush=True)
sys.stdin.read()
"""


def record(
    episode: int, seconds: float = 1.0, outcome: str = "success", task: str = "BinFill"
) -> EpisodeRecord:
    times = Seconds(sim=0.75 * seconds, policy=0.25 * seconds, total=2 * seconds)
    return EpisodeRecord("tiny", 1, 7, task, episode, 1, "easy", outcome, 5, times)


def taken(job: Job | None) -> int | None:
    return None if job is None else job.episode


def test_each_episode_is_taken_once(tmp_path: Path) -> None:
    names = [f"episodes-{i}of2.jsonl" for i in range(2)]
    with RecordLog(tmp_path / names[0]), RecordLog(tmp_path / names[1]):
        first, second = (Claims(tmp_path, name) for name in names)
        assert [taken(claims.take(JOBS)) for claims in (first, second, second, first)] == [
            0,
            1,
            2,
            3,
        ]
        assert first.take(JOBS) is None and second.take(JOBS) is None


def test_no_draft_is_written_where_another_claim_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = Claims(tmp_path, "episodes-0of2.jsonl"), Claims(tmp_path, "episodes-1of2.jsonl")
    with RecordLog(tmp_path / "episodes-0of2.jsonl"):
        assert taken(first.take(JOBS[:1])) == 0
        monkeypatch.setattr(claims_file, "write_new", lambda path, text: pytest.fail("was written"))
        assert second.take(JOBS[:1]) is None


@pytest.mark.parametrize(
    "first, second, is_refused",
    [
        ("episodes.jsonl", "episodes-0of2.jsonl", True),
        ("episodes-1of2.jsonl", "episodes.jsonl", True),
        ("episodes-1of2.jsonl", "episodes-0of2.jsonl", False),
    ],
)
def test_one_process_does_not_run_what_shards_share(
    first: str, second: str, is_refused: bool, tmp_path: Path
) -> None:
    with RecordLog(tmp_path / first):
        RecordLog(tmp_path / second).close()
        if is_refused:
            with pytest.raises(UserError, match=f"{first} is being written.*needs shard="):
                check_sharing(tmp_path, second)
        else:
            check_sharing(tmp_path, second)
    check_sharing(tmp_path, second)


def test_a_process_starts_while_another_checks_that_it_is_alive(tmp_path: Path) -> None:
    path = tmp_path / "episodes-0of2.jsonl"
    path.touch()
    with path.open("rb") as probe:
        fcntl.flock(probe, fcntl.LOCK_SH)  # as `Claims` does, for a moment
        threading.Timer(0.1, probe.close).start()
        RecordLog(path).close()


@pytest.mark.slow
def test_unfinished_episodes_of_a_killed_process_are_taken_again(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", TAKE_TWO, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "taken\n"
    other = "episodes-1of2.jsonl"
    with RecordLog(tmp_path / other):
        claims = Claims(tmp_path, other)
        assert taken(claims.take(JOBS)) == 2  # the process is alive and holds 0 and 1
        process.kill()
        process.communicate()
        assert [taken(claims.take(JOBS)) for _ in range(3)] == [1, 3, None]  # it had finished 0
        with RecordLog(tmp_path / "episodes-0of2.jsonl"):  # restarted under its old name
            again = Claims(tmp_path, "episodes-0of2.jsonl")
            assert again.take(JOBS) is None


def test_a_restarted_process_gives_back_its_unfinished_episodes(tmp_path: Path) -> None:
    names = [f"episodes-{i}of2.jsonl" for i in range(2)]
    with RecordLog(tmp_path / names[0]) as log:
        before = Claims(tmp_path, names[0])
        assert [taken(before.take(JOBS)) for _ in range(2)] == [0, 1]
        log.append(record(0))
    with RecordLog(tmp_path / names[0]), RecordLog(tmp_path / names[1]):
        Claims(tmp_path, names[0])
        other = Claims(tmp_path, names[1])
        assert [taken(other.take(JOBS)) for _ in range(2)] == [1, 2]


def test_one_of_two_processes_takes_over_a_stale_claim(tmp_path: Path) -> None:
    with RecordLog(tmp_path / "episodes-0of3.jsonl"):
        Claims(tmp_path, "episodes-0of3.jsonl").take(JOBS[:1])
    names = [f"episodes-{i}of3.jsonl" for i in (1, 2)]
    with RecordLog(tmp_path / names[0]), RecordLog(tmp_path / names[1]):
        first, second = (Claims(tmp_path, name) for name in names)  # both have read the stale claim
        assert [taken(claims.take(JOBS[:1])) for claims in (first, second)] == [0, None]


@pytest.mark.parametrize(("process", "holds"), [(1, True), (2**22 + 1, False)])
def test_without_locks_the_process_number_decides(
    process: int, holds: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(claims_file.fcntl, "flock", no_locks)
    (tmp_path / "episodes-0of2.jsonl").touch()
    write_json(
        tmp_path / "claims" / "BinFill-0.0.json",
        vars(claims_file.Claim("episodes-0of2.jsonl", process=process)),
    )
    assert (Claims(tmp_path, "episodes-1of2.jsonl").take(JOBS[:1]) is None) == holds


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        "{}",
        '{"records": 7, "host": "a", "process": 1}',
        "\x00",
        '{"records": "../episodes.jsonl", "host": "a", "process": 1}',
        '{"records": "/etc/passwd", "host": "a", "process": 1}',
        '{"records": null, "host": "a", "process": 0}',
        '{"records": null, "host": "a", "process": true}',
        '{"records": null, "host": "a", "process": 1, "more": 1}',
    ],
)
def test_a_damaged_claim_is_named(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(claims_file, "await_content", lambda path: None)
    joined = Claims(tmp_path, "episodes-0of2.jsonl")
    path = tmp_path / "claims" / "BinFill-0.0.json"
    path.parent.mkdir()
    path.write_text(content)
    for read in (lambda: Claims(tmp_path, "episodes-1of2.jsonl"), lambda: joined.take(JOBS)):
        with pytest.raises(
            UserError, match=r"claims/BinFill-0\.0\.json is damaged.*Remove the folder"
        ):
            read()


def test_episodes_that_took_longest_begin_first() -> None:
    durations = Durations([record(0, 1), record(1, 4), record(0, 8, task="PickXtimes")])
    jobs = [*JOBS[:3], Job("PickXtimes", "test", 5), Job("StopCube", "test", 0)]
    order = durations.longest_first(jobs)
    assert [(job.task, job.episode) for job in order] == [
        ("PickXtimes", 5), ("StopCube", 0), ("BinFill", 1), ("BinFill", 2), ("BinFill", 0),
    ]  # fmt: skip
    assert Durations([]).longest_first(jobs) == jobs


def test_the_forecast_follows_whoever_is_slower() -> None:
    durations = Durations([record(0, 3600)])
    assert "about 3.0 h" in durations.forecast(JOBS, workers=1)  # three quarters of each
    assert "about 1.0 h" in durations.forecast(JOBS, workers=4)  # the policy's, one by one
    assert durations.forecast(JOBS * 10, workers=4, processes=2) == (
        "forecast: about 5.0 h for 40 episodes, 8 at a time, if they take as long as the 1"
        " before them did"
    )
    assert Durations([]).forecast(JOBS, workers=1) is None
    short = Durations([record(0, 4)]).forecast(JOBS[:1], workers=1)
    assert short.startswith("forecast: about a minute at most for 1 episode, 1 at a time")


def test_an_episode_that_is_tried_again_comes_last() -> None:
    waiting = Waiting(JOBS[:2])
    waiting.put_back(waiting.take())
    assert [taken(waiting.take()) for _ in range(3)] == [1, 0, None]


def test_nothing_is_said_of_equal_runs_that_end_alike() -> None:
    protocol = Protocol(("BinFill",), 2)
    twice = [record(0), record(1), record(0, 2), record(1, 2)]
    other = [EpisodeRecord("else", 1, 7, "BinFill", i, 1, "easy", "fail", 5) for i in range(2)]
    results = aggregate([*twice, *other], protocol, conflicts="first")
    method = results.method("tiny")
    assert (method.repeated, method.flipped) == (2, 0)
    assert not any("more than once" in note for note in results.notes)
    assert "twice" not in compare(method, results.method("else"), protocol).verdict


def test_episodes_that_end_otherwise_between_equal_runs_are_counted() -> None:
    protocol = Protocol(("BinFill",), 4)
    once = [record(i) for i in range(4)]
    twice = [*once, record(0, 2), record(1, outcome="fail"), record(2, outcome="error")]
    twice += once  # a copy of the file, as of a second machine, repeats nothing
    other = [EpisodeRecord("else", 1, 7, "BinFill", i, 1, "easy", "fail", 5) for i in range(4)]
    results = aggregate([*twice, *other], protocol, conflicts="first")
    method = results.method("tiny")
    assert (method.repeated, method.flipped) == (2, 1)
    assert any("of 2 episodes run more than once" in note for note in results.notes)
    comparison = compare(method, results.method("else"), protocol)
    assert (comparison.repeated, comparison.flipped) == (2, 1)
    assert comparison.verdict.endswith("of 2 episodes run twice alike, 1 ended otherwise")
    alone = aggregate([*once, *other], protocol)
    assert "run twice" not in compare(alone.method("tiny"), alone.method("else"), protocol).verdict
