"""MIKASA-Robo-VLA by choices: what can be chosen, and the oracle that knows the answer."""

from typing import Any

import numpy as np
import pytest

from mme_vla.embodiment import Embodiment
from mme_vla.envs.base import CHOICES, OPTIONS, environment
from mme_vla.errors import UserError
from mme_vla.extras.mikasa.catalog import FAMILY_OF


def test_tasks_are_those_whose_answer_is_one_of_several_things() -> None:
    source = environment("mikasa_choices")
    kinds = {FAMILY_OF[task].memory for task in source.tasks}
    assert len(source.tasks) == 46
    assert kinds == {"Object", "Negative", "Spatial", "Capacity", "Sequential"}
    with pytest.raises(UserError, match=r"RotateLenientPos has nothing to choose: take env=mikasa"):
        source.check_task("RotateLenientPos")


def opened(task: str, episode: int = 0, **more: Any) -> Any:
    source = environment("mikasa_choices")
    return source.open(task, "test", episode, action_space=CHOICES, render=False, **more)


@pytest.mark.slow
@pytest.mark.usefixtures("simulator")
@pytest.mark.parametrize(
    ("task", "n_options", "decisions"),
    [
        ("RememberColor5", 5, 1),
        ("RememberShapeAndColor5x3", 15, 1),
        ("FindImposterShape3", 3, 1),
        ("BunchOfColors3", 10, 4),
        ("ChainOfColors3", 10, 4),
        ("TakeItBack", 4, 2),
    ],
)
def test_the_oracle_solves_a_task_by_choices(task: str, n_options: int, decisions: int) -> None:
    env = opened(task)
    _, report = env.reset()
    options = [option["action"] for option in report[OPTIONS]]
    assert len(set(options)) == n_options
    letters = Embodiment.from_dict(environment("mikasa_choices").embodiment).action.choice
    assert n_options <= len(letters)
    chosen = []
    while report["status"] == "ongoing":
        choice = env.oracle()
        chosen.append(options["abcdefghijklmno".index(choice["choice"])])
        *_, report = env.step(choice)
        if report["status"] == "ongoing":
            assert [option["action"] for option in report[OPTIONS]] == options
    assert report["status"] == "success" and len(chosen) == decisions
    if decisions == 1:
        (name,) = [name for name in env.env.scene_facts.things() if name in chosen[0]]
        assert chosen == [f"touch the {name}"]


@pytest.mark.slow
@pytest.mark.usefixtures("simulator")
def test_a_wrong_choice_is_carried_out_and_no_success() -> None:
    env = opened("RememberColor3")
    _, report = env.reset()
    right = env.oracle()["choice"]
    wrong = next(letter for letter in "abc" if letter != right)
    *_, report = env.step({"choice": wrong})
    touched = list(env.env.scene_facts.things().values())["abc".index(wrong)]
    gap = touched.pose.p[0].numpy() - env.env.scene.agent.tcp.pose.p[0].numpy()
    assert np.linalg.norm(gap) < 0.05 and report["status"] == "timeout"


@pytest.mark.slow
@pytest.mark.usefixtures("simulator")
@pytest.mark.parametrize("task", ["FindImposterColor3", "SeqOfColors3", "ChainOfColors3"])
def test_a_decision_between_twins_is_where_the_flipped_thing_is_chosen(task: str) -> None:
    source = environment("mikasa_choices")
    rights = []
    for row in (None, source.twin(source.episode(task, "test", 0))):
        env = opened(task, row=row)
        _, report = env.reset()
        while env.candidates is None:
            *_, report = env.step(env.oracle())
        assert report["status"] == "ongoing"
        rights.append((list(env.candidates.correct), env.oracle()["choice"]))
        env.close()
    assert rights[0][0] != rights[1][0] and rights[0][1] != rights[1][1]
