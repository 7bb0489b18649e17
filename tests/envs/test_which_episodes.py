"""`tasks=` and `episodes=` mean the same in every command."""

import pytest

from mme_vla.cli import record
from mme_vla.config.composition import compose, resolved
from mme_vla.envs.episodes import choose_episodes, choose_numbers, named_tasks
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout import evaluation as rollout_plan

COMMANDS = pytest.mark.parametrize("command", ["evaluate", "play", "record", "show"])


@pytest.mark.parametrize(
    ("episodes", "numbers"),
    [
        (3, [0, 1, 2]),
        ([3], [3]),
        ("0-2", [0, 1, 2]),
        (["0-2", 7], [0, 1, 2, 7]),
        ([4, 1], [4, 1]),
        ("all", list(range(50))),
    ],
)
def test_episodes_are_named_by_their_count_number_or_range(
    episodes: object, numbers: list[int]
) -> None:
    assert choose_numbers(episodes, 50) == numbers


@COMMANDS
def test_the_same_words_choose_the_same_episodes_in_every_command(command: str) -> None:
    more = ["output=x", "split=test"] if command == "record" else []
    cfg = compose(command, ["tasks=[StopCube,BinFill]", "episodes=[0-2,7]", *more])
    choose = rollout_plan.choose_jobs if command == "evaluate" else choose_episodes
    specs = (
        record.plan(record.RecordRun.from_config(resolved(cfg)))
        if command == "record"
        else choose(named_tasks(cfg), cfg.episodes, cfg.split)
    )
    expected = [(task, number) for task in ("StopCube", "BinFill") for number in (0, 1, 2, 7)]
    assert [(spec.task, spec.episode) for spec in specs] == expected


@COMMANDS
def test_task_means_tasks(command: str) -> None:
    more = ["output=x", "episodes=1"] if command == "record" else []
    assert named_tasks(compose(command, ["task=BinFill", *more])) == "BinFill"
    with pytest.raises(UserError, match="mean the same: give one"):
        named_tasks(compose(command, ["task=BinFill", "tasks=StopCube", *more]))


def test_commands_that_need_tasks_ask_for_them() -> None:
    with pytest.raises(UserError, match="Name the tasks"):
        named_tasks(compose("play", []))
    assert named_tasks(compose("evaluate", [])) == "all"


@pytest.mark.parametrize(
    "episodes", [0, 51, True, 2.5, "1-", "a", [1, 1], ["3-1"], [], [None], "0-999999999"]
)
def test_what_names_no_episodes_is_refused_at_once(episodes: object) -> None:
    with pytest.raises(UserError, match="episode"):
        choose_numbers(episodes, 50)


@pytest.mark.parametrize("episodes", [99, "5-2", [3, 3]])
def test_a_wrong_number_is_reported_under_its_key(episodes: object) -> None:
    with pytest.raises(UserError, match=r"^recorded="):
        choose_numbers(episodes, 12, "the data", "recorded")
