"""Scenes of every task are those of `tests/data/task_scenes.json`: the words, what was sampled,
where things stand.

A scene of the file holds what `describe` returns, numbers rounded to six decimals, of some scenes
without the words.
"""

import json
from typing import Any

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers import REPOSITORY
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import TASK_NAMES

SCENES = json.loads((REPOSITORY / "tests" / "data" / "task_scenes.json").read_text())


def describe(task: str, **scene: Any) -> dict[str, Any]:
    env = make_task(task, render=False, **scene)
    env.reset()
    description = {
        "goals": env.goals(),
        "subtasks": [
            [
                step.text,
                step.grounded_text,
                step.choice,
                step.video,
                [thing.name for thing in step.targets],
            ]
            for step in env.progress.subtasks
        ],
        "choices": [[option.label, option.action, option.needs_point] for option in env.choices()],
        "values": env.scene_values()["spec"],
        "places": {
            thing.name: [*thing.pose.p.tolist(), *thing.pose.q.tolist()] for thing in env.things
        },
    }
    env.close()
    return description


def leaves(value: Any, path: str = "") -> dict[str, Any]:
    """What is in nested dicts and lists, by its path; an empty one is there itself."""
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    flat = {
        name: leaf for key, item in items for name, leaf in leaves(item, f"{path}.{key}").items()
    }
    return flat or {path: value}


def is_close(actual: Any, recorded: Any) -> bool:
    return (
        abs(actual - recorded) <= 1e-5 if isinstance(recorded, int | float) else actual == recorded
    )


def test_every_task_is_in_the_file() -> None:
    assert {scene["task"] for scene in SCENES} == set(TASK_NAMES)


@pytest.mark.parametrize(
    "recorded", SCENES, ids=lambda s: f"{s['task']}-{s['seed']}-{s['difficulty']}"
)
def test_a_scene_has_its_words_values_and_places(recorded: dict[str, Any]) -> None:
    recorded = dict(recorded)
    scene = {
        key: recorded.pop(key)
        for key in ("task", "seed", "difficulty", "recovery")
        if key in recorded
    }
    described = describe(**scene)
    actual, expected = leaves({key: described[key] for key in recorded}), leaves(recorded)
    assert actual.keys() == expected.keys()
    assert {
        path: actual[path] for path in expected if not is_close(actual[path], expected[path])
    } == {}
