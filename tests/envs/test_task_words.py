"""Goals, sub-tasks and options of every task are worded as in `tests/data/task_words.json`."""

import json

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers import REPOSITORY
from helpers.env_tasks import make
from mme_vla.envs.make import load_tasks
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.registry import TASKS

SCENES = json.loads((REPOSITORY / "tests" / "data" / "task_words.json").read_text())


def test_every_task_is_in_the_table() -> None:
    assert {scene["task"] for scene in SCENES} == set(TASK_NAMES)


@pytest.mark.parametrize("words", SCENES, ids=lambda words: f"{words['task']}-{words['seed']}")
def test_goals_sub_tasks_and_options_have_their_words(words: dict) -> None:
    load_tasks(words["task"])
    env = make(TASKS[words["task"]], words["seed"], words["difficulty"])
    steps = [
        [step.text, step.grounded_text, step.choice, step.video, [thing.name for thing in step.targets]]
        for step in env.progress.subtasks
    ]
    options = [[option.label, option.action, option.needs_point] for option in env.choices()]
    goals = env.goals()
    env.close()
    assert goals == words["goals"] and steps == words["subtasks"] and options == words["choices"]
