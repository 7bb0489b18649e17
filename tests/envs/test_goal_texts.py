"""Every wording of every goal is the benchmark's, in its order: `tests/data/goal_texts.json`, by
task and variant.

The file has the texts of `setup/task_goal` in the official recordings, with `{}` around what a
scene decides.
"""

import json
from collections import Counter
from itertools import permutations, product
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers import REPOSITORY
from helpers.env_tasks import built
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import TASK_NAMES

TEXTS: dict[str, dict[str, list[str]]] = json.loads(
    (REPOSITORY / "tests" / "data" / "goal_texts.json").read_text()
)
FACTS = REPOSITORY.parent / "shared" / "spec" / "goals.json"
COLOURS = ("red", "blue", "green")
NUMBERS = ("one", "two", "three", "four", "five")
ORDINALS = ("first", "second", "third", "fourth", "fifth")
# of the test split: every difficulty
SCENES = [(task, episode) for task in TASK_NAMES for episode in (0, 2, 3)]

Case = tuple[dict[str, Any], str, dict[str, str]]
"""What a scene has, which variant of the texts that is, and what fills them."""


def object_of(colour: str) -> SimpleNamespace:
    return SimpleNamespace(colour=colour)


def repetitions(most: int, variants: dict[int, str]) -> list[Case]:
    """Every colour and count; `variants` by the count, 0 for the others."""
    cases: list[Case] = []
    for colour, count in product(COLOURS, range(1, most + 1)):
        facts = {"cube": object_of(colour), "repetitions": count}
        cases.append(
            (
                facts,
                variants.get(count, variants[0]),
                {"colour": colour, "number": NUMBERS[count - 1]},
            )
        )
    return cases


def bin_contents() -> list[Case]:
    """Every count of every colour up to five cubes in all."""
    cases: list[Case] = []
    for counts in product(range(6), repeat=3):
        if 1 <= sum(counts) <= 5:
            cases.append(
                (
                    {"goal": Counter(dict(zip(COLOURS, counts, strict=True)))},
                    "every",
                    bin_words(counts),
                )
            )
    return cases


def bin_words(counts: tuple[int, ...]) -> dict[str, str]:
    parts = []
    for colour, count in zip(COLOURS, counts, strict=True):
        if count == 1:
            parts.append(f"one {colour} cube")
        elif count > 1:
            parts.append(f"{NUMBERS[count - 1]} {colour} cubes")
    *earlier, last = parts
    if not earlier:
        return {"list": last}
    return {"list": f"{', '.join(earlier)} and {last}"}


def visits() -> list[Case]:
    return [({"visit": i + 1}, "every", {"ordinal": ordinal}) for i, ordinal in enumerate(ORDINALS)]


def hidden() -> list[Case]:
    """Every order of the colours, one and two of them to be found."""
    cases: list[Case] = []
    for colours in permutations(COLOURS):
        words = {"colour": colours[0], "colour 2": colours[1]}
        cases.append(({"colours": colours, "pick_count": 1}, "one pick", words))
        cases.append(({"colours": colours, "pick_count": 2}, "two picks", words))
    return cases


def placed_by_the_button() -> list[Case]:
    cases: list[Case] = []
    for colour in COLOURS:
        cases.append(({"cube": object_of(colour), "before": True}, "before", {"colour": colour}))
        cases.append(({"cube": object_of(colour), "before": False}, "after", {"colour": colour}))
    return cases


def placed_in_order() -> list[Case]:
    return [
        (
            {"cube": object_of(colour), "rank": rank},
            "every",
            {"colour": colour, "ordinal": ORDINALS[rank - 1]},
        )
        for colour, rank in product(COLOURS, range(1, 5))
    ]


ONE_GOAL: list[Case] = [({}, "every", {})]
CASES: dict[str, list[Case]] = {
    "PickXtimes": repetitions(5, {1: "1", 0: ">1"}),
    "SwingXtimes": repetitions(3, {1: "1", 0: ">1"}),
    "VideoRepick": repetitions(5, {1: "1", 2: "2", 0: ">2"}),
    "BinFill": bin_contents(),
    "StopCube": visits(),
    "VideoPlaceButton": placed_by_the_button(),
    "VideoPlaceOrder": placed_in_order(),
    **dict.fromkeys(
        ("VideoUnmask", "VideoUnmaskSwap", "ButtonUnmask", "ButtonUnmaskSwap"), hidden()
    ),
    **dict.fromkeys(
        ("PickHighlight", "InsertPeg", "MoveCube", "PatternLock", "RouteStick"), ONE_GOAL
    ),
}


def official(task: str, variant: str, words: dict[str, str]) -> list[str]:
    """The wordings with these words in their places."""
    texts = TEXTS[task][variant]
    for place, word in words.items():
        texts = [text.replace(f"{{{place}}}", word) for text in texts]
    return texts


@pytest.mark.parametrize("task", TASK_NAMES)
def test_a_goal_has_every_official_wording_in_order(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = built(task, 0)
    for facts, variant, words in CASES[task]:
        for name, value in facts.items():
            monkeypatch.setattr(env, name, value)
        assert env.goals() == official(task, variant, words)
    env.close()


def test_the_cases_have_every_variant() -> None:
    assert CASES.keys() == TEXTS.keys() == set(TASK_NAMES)
    for task, cases in CASES.items():
        assert {variant for _, variant, _ in cases} == TEXTS[task].keys(), task


@pytest.mark.parametrize(("task", "episode"), SCENES)
def test_the_goal_of_a_scene_is_one_of_the_official_ones(task: str, episode: int) -> None:
    env = built(task, episode)
    every = [official(task, variant, words) for _, variant, words in CASES[task]]
    assert env.goals() in every
    env.close()


def test_a_recovery_demonstration_has_the_goal_of_its_scene() -> None:
    scene: dict[str, Any] = {"seed": 9200, "difficulty": "medium", "render": False}
    goals = []
    for recovery in (None, "z", "xy"):
        env = make_task("VideoRepick", recovery=recovery, **scene)
        env.reset()
        goals.append(env.goals())
        env.close()
    assert goals[0] == goals[1] == goals[2]


def test_the_texts_are_those_of_the_facts() -> None:
    if not FACTS.is_file():
        pytest.skip(f"{FACTS} is absent")
    facts = json.loads(FACTS.read_text())
    assert facts.keys() - {"_"} == TEXTS.keys()
    for task, variants in TEXTS.items():
        stated = facts[task]
        beginnings = {}
        if isinstance(stated, str):  # "as VideoUnmask", or "as ButtonUnmask, with 'x' for 'y'"
            other, _, change = stated.removeprefix("as ").partition(",")
            stated = facts[other]
            if change:
                _, new, _, old, _ = change.split("'")
                beginnings = {old: new}
        for variant, texts in variants.items():
            expected = stated["*" if variant == "every" else variant]
            for old, new in beginnings.items():
                expected = [text.replace(old, new) for text in expected]
            assert texts == expected, (task, variant)
