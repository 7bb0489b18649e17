"""Process scores: where an episode's chain of sub-tasks broke, and at what, from the environment to
the tables.
"""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import Hand, make, push_down
from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from helpers.scripted_env import ScriptedEnv
from mme_vla.envs import metadata
from mme_vla.envs.make import load_tasks
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.envs.robomme.tasks.pick_xtimes import PickXtimes
from mme_vla.envs.subtasks import OPERATIONS, ProcessScore, Progress, SubTask, process_score
from mme_vla.envs.task import Task
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.curves import process_tables
from mme_vla.evaluation.results.report import html_report
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.registry import TASKS


@pytest.fixture(scope="module")
def twice() -> Iterator[Task]:
    env = make(PickXtimes, 1600, "medium")  # two repetitions, three cubes
    yield env
    env.close()


def test_who_stops_too_early_has_lost_count_and_who_takes_another_cube_has_not(
    twice, monkeypatch
) -> None:
    twice.reset()
    hand = Hand(twice, monkeypatch)
    hand.carry(twice.cube)
    hand.release(twice.target.position)
    assert process_score(twice.progress, "timeout") == ProcessScore(
        2, 5, "stuck", "", twice.progress.subtasks[2].text
    )
    assert push_down(twice, twice.button) == (False, True)
    early = process_score(twice.progress, "fail")
    assert (early.done, early.of, early.broke, early.operation) == (2, 5, "wrong", "how many")
    twice.reset()
    hand.carry(next(cube for cube in twice.cubes if cube is not twice.cube))
    other = process_score(twice.progress, "fail")
    assert (other.done, other.broke, other.operation) == (0, "wrong", "motion")


@pytest.mark.parametrize("task", TASK_NAMES)
def test_every_task_says_what_its_sub_tasks_ask_of_memory(task: str) -> None:
    load_tasks(task)
    spec = metadata.episode(task)
    env: Any = make(TASKS[task], spec.seed, spec.difficulty)
    operations = [
        subtask.operation
        for subtask in env.progress.subtasks
        if not subtask.video and subtask.operation
    ]
    assert operations and all(
        callable(operation) or operation in OPERATIONS for operation in operations
    )
    assert {operation() for operation in operations if callable(operation)} <= {"", *OPERATIONS}
    env.close()


def test_a_success_has_done_everything_and_the_mistake_is_that_of_the_failure() -> None:
    watch = SubTask("watch", lambda: True, lambda _: None, video=True)
    choose = SubTask(
        "choose", lambda: False, lambda _: None, failed=lambda: True, operation=lambda: "order"
    )
    steps = [watch, choose]
    progress = Progress(steps, latch_failure=False)
    assert process_score(progress, "timeout").done == 0
    for _ in range(2):
        progress.update()
    assert process_score(progress, "fail") == ProcessScore(0, 1, "wrong", "order", "choose")
    assert process_score(progress, "success") == ProcessScore(1, 1)


class ReportingEnv(ScriptedEnv):
    """Also has a pointer over sub-tasks, as a simulated task has."""

    task = SimpleNamespace(
        progress=Progress([SubTask("push", lambda: False, lambda _: None)], latch_failure=True)
    )


def make_reporting_env(
    task: str, split: str, episode: int, max_steps: int = 40, **options: Any
) -> ReportingEnv:
    return ReportingEnv(task, episode, max_steps, 1e9, 0.0, "")


def test_records_tables_and_the_report_tell_it() -> None:
    policy = quick_policy("pi05").eval()
    (record,) = roll(policy, [Job("PickXtimes", "test", 0)], InlineEnvs(base=make_reporting_env))
    assert record.process is not None
    assert ProcessScore.from_dict(record.process) == ProcessScore(0, 1, "stuck", "", "push")
    (silent,) = roll(policy, [Job("PickXtimes", "test", 0)], InlineEnvs())
    assert silent.process is None
    scores = [
        ProcessScore(1, 4, "wrong", "how many", "x"),
        ProcessScore(3, 4, "stuck", "", "y"),
        ProcessScore(4, 4),
    ]
    outcomes = ["fail", "timeout", "success"]
    rows = [
        EpisodeRecord("m", 1, 7, "PickXtimes", i, i, "easy", outcome, 9, process=score.to_dict())
        for i, (outcome, score) in enumerate(zip(outcomes, scores, strict=True))
    ]
    results = aggregate(
        [EpisodeRecord.from_json(r.to_json()) for r in rows], Protocol(("PickXtimes",), 3), "test"
    )
    (table,) = process_tables(results)
    row = dict(zip(table.columns, table.rows[-1], strict=True))
    assert (row["episodes"], row["progress (%)"], row["how many"], row["stuck"]) == (
        "3",
        "66.7",
        "1",
        "1",
    )
    assert row["where"] == "–" and row["success"] == "1"
    assert "where the chain broke" in html_report(results, [], "t")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"broke": "torn"}, "record.process.broke='torn' must be empty or one of wrong, stuck"),
        ({"operation": "when"}, "record.process.operation='when' must be empty or one of motion"),
        ({"done": "1"}, "record.process.done='1' must be a whole number"),
        ({"ended": 3}, "Unknown key record.process.ended"),
    ],
)
def test_a_damaged_process_score_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        ProcessScore.from_dict({"done": 1, "of": 2, **change})
    with pytest.raises(UserError, match="lacks the key 'of'"):
        ProcessScore.from_dict({"done": 1})
