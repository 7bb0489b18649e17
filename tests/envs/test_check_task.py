"""`check_task` finds each of these mistakes, and names what is wrong."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from helpers import REPOSITORY
from mme_vla.config.plugins import import_plugins
from mme_vla.registry import TASKS
from mme_vla.testing import check_task

pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim` has it")


def by_chance() -> int:
    return os.urandom(1)[0]


def unplayable(demonstrator: Any, thing: Any) -> None:
    raise KeyError("button")


# What the example task's method returns → what the mistaken one's does.
CHANGES: dict[str, tuple[str, Callable[[Any], Any], str]] = {
    "goals by chance": (
        "goals",
        lambda goals: [f"{goals[0]} {by_chance()}"],
        r"differ in goals\(\)",
    ),
    "order by chance": (
        "subtasks",
        lambda subtasks: subtasks[:: 1 if by_chance() % 2 else -1],
        r"differ in subtasks\(\)|do not end in success|demonstrations of one seed differ",
    ),
    "nothing happens": (
        "subtasks",
        lambda subtasks: [
            replace(subtask, done=lambda: True, run=lambda demo: None) for subtask in subtasks
        ],
        "without one step of the robot",
    ),
    "done without being done": (
        "subtasks",
        lambda subtasks: [replace(subtask, done=lambda: True) for subtask in subtasks],
        "a success (though|without)",
    ),
    "no options": ("choices", lambda choices: [], "must give at least one option"),
    "an option that raises": (
        "choices",
        lambda choices: [choices[0], replace(choices[1], run=unplayable)],
        r"option 'b' of choices\(\) .* raises KeyError",
    ),
    "an option that is missing": (
        "choices",
        lambda choices: choices[:1],
        r"name the options \['b'\], which choices\(\) lacks",
    ),
}


@pytest.mark.parametrize("mistake", CHANGES)
def test_it_finds(mistake: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "two_buttons")
    import_plugins(["two_buttons"])
    method, change, message = CHANGES[mistake]
    released = getattr(TASKS["TwoButtons"], method)
    monkeypatch.setattr(TASKS["TwoButtons"], method, lambda task: change(released(task)))
    with pytest.raises(AssertionError, match=message):
        check_task("TwoButtons")
