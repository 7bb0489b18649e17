"""`tasks=` and `episodes=` mean the same in every command."""

import pytest

from mme_vla.cli import record
from mme_vla.config.composition import compose
from mme_vla.envs.episodes import choose_episodes, choose_numbers, named_tasks
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout import evaluation as rollout_plan


@pytest.mark.parametrize(
    ("episodes", "numbers"),
    [
        ("3", [0, 1, 2]),
        ("[3]", [3]),
        ("0-2", [0, 1, 2]),
        ("[0-2,7]", [0, 1, 2, 7]),
        ("[4,1]", [4, 1]),
        ("all", list(range(50))),
    ],
)
def test_the_same_words_choose_the_same_episodes_in_every_command(episodes: str, numbers: list[int]) -> None:
    overrides = ["tasks=[StopCube,BinFill]", f"episodes={episodes}"]
    expected = [(task, number) for task in ("StopCube", "BinFill") for number in numbers]
    episodes_by_command = {}
    for command in ("evaluate", "play", "record", "show"):
        more = ["output=x", "split=test"] if command == "record" else []
        cfg = compose(command, [*overrides, *more])
        named = (named_tasks(cfg), cfg.episodes, cfg.split)
        episodes_by_command[command] = {
            "evaluate": lambda: rollout_plan.choose_episodes(*named),  # noqa: B023 (called at once)
            "record": lambda: record.plan(cfg),  # noqa: B023
            **dict.fromkeys(("play", "show"), lambda: choose_episodes(*named)),  # noqa: B023
        }[command]()
    assert {name: [(e.task, e.episode) for e in specs] for name, specs in episodes_by_command.items()} == dict.fromkeys(
        ("evaluate", "play", "record", "show"), expected
    )


@pytest.mark.parametrize("command", ["evaluate", "play", "record", "show"])
def test_task_means_tasks(command: str) -> None:
    more = ["output=x", "episodes=1"] if command == "record" else []
    assert named_tasks(compose(command, ["task=BinFill", *more])) == "BinFill"
    with pytest.raises(UserError, match="mean the same: give one"):
        named_tasks(compose(command, ["task=BinFill", "tasks=StopCube", *more]))


def test_commands_that_need_tasks_ask_for_them() -> None:
    with pytest.raises(UserError, match="Name the tasks"):
        named_tasks(compose("play", []))
    assert named_tasks(compose("evaluate", [])) == "all"


@pytest.mark.parametrize("episodes", [0, 51, True, 2.5, "1-", "a", [1, 1], ["3-1"], [], [None], "0-999999999"])
def test_what_names_no_episodes_is_refused_at_once(episodes: object) -> None:
    with pytest.raises(UserError, match="episode"):
        choose_numbers(episodes, 50)
