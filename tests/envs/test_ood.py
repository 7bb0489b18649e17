"""RoboMME-OOD: its rows, its words, and the rules in which it differs from the benchmark."""

import json
import os
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.tiers import slow_or_nightly

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from mme_vla.envs import metadata
from mme_vla.envs.make import load_tasks, make_env, make_task
from mme_vla.envs.metadata import TASK_NAMES, step_limit
from mme_vla.envs.robomme.recording.recorder import Recorder
from mme_vla.envs.robomme.scene.motions import COVER_STEPS
from mme_vla.envs.robomme.scene.placement import Draws, rotated_anchors
from mme_vla.envs.task import Task
from mme_vla.errors import UserError

FOLDER = Path(
    os.environ.get("MME_VLA_OOD") or Path(__file__).resolve().parents[3] / "shared" / "ood"
)
CELLS = {
    ("PickXtimes", "RouteStick", "PatternLock"): (17, 17, 16),
    ("SwingXtimes", "StopCube"): (10, 10, 10, 10, 10),
    ("VideoUnmask", "ButtonUnmask"): (13, 13, 12, 12),
    ("MoveCube", "InsertPeg"): (0, 0, 0, 50),
}
SLOW_TASKS = ("VideoUnmask", "PickXtimes", "RouteStick")
"""One task a robot and kind of scene; the others are nightly."""


@pytest.fixture(scope="module", autouse=True)
def _tasks() -> None:
    load_tasks(*TASK_NAMES)


@contextmanager
def scene(task: str, episode: int = 0, split: str = "ood") -> Iterator[Task]:
    env = make_task(task, render=False, **metadata.episode(task, split, episode).options)
    env.reset()
    yield env
    env.close()


def texts(env: Task, video: bool = False) -> list[str]:
    return [subtask.text for subtask in env.progress.subtasks if subtask.video == video]


def test_every_task_has_fifty_episodes_in_its_tiers() -> None:
    cells = {task: counts for tasks, counts in CELLS.items() for task in tasks}
    for task in TASK_NAMES:
        tiers = Counter(spec.difficulty for spec in metadata.episodes(task, "ood"))
        expected = cells.get(task, (25, 25))
        assert tiers == Counter({f"xhard{i + 1}": count for i, count in enumerate(expected)})
        for tier in tiers:
            specs = metadata.episodes(task, f"ood:{tier}")
            assert [spec.difficulty for spec in specs] == [tier] * tiers[tier]
            assert [spec.episode for spec in specs] == list(range(tiers[tier]))


def test_the_shipped_rows_are_those_of_the_published_seeds() -> None:
    if not FOLDER.is_dir():
        pytest.skip(f"no rows to compare with: {FOLDER} is absent (set MME_VLA_OOD)")
    for task in TASK_NAMES:
        rows = [json.loads(line) for line in (FOLDER / f"{task}.jsonl").read_text().splitlines()]
        assert [spec.row for spec in metadata.episodes(task, "ood")] == rows


def test_seeds_follow_from_tier_task_and_candidate() -> None:
    offsets = {f"xhard{i + 1}": 16_000_000 + 2_000_000 * i for i in range(5)}
    for code, task in enumerate(TASK_NAMES, 1):
        for spec in metadata.episodes(task, "ood"):
            assert spec.row is not None
            attempt = spec.row["candidate"] * 100 + spec.row["attempt"]
            assert spec.seed == offsets[spec.difficulty] + 100_000 * code + attempt


def test_anchors_sampled_from_the_seeds_are_the_published_ones() -> None:
    for spec in metadata.episodes("VideoUnmaskSwap", "ood"):
        draws = Draws(spec.seed)
        anchor = rotated_anchors(draws, 4)[0]
        place = [
            anchor[axis] - 0.07 + 0.0275 + draws.uniform() * 2 * (0.07 - 0.0275) for axis in (0, 1)
        ]
        assert spec.row is not None
        np.testing.assert_allclose(
            spec.row["spec"]["layout"]["bins"][0][:2], place, rtol=0, atol=1e-15
        )


def test_other_splits_and_their_limits_of_steps() -> None:
    hard, test = (metadata.episodes("MoveCube", split) for split in ("hard", "test"))
    assert [spec.seed for spec in hard] == [spec.seed for spec in test[3::4]]
    assert {spec.difficulty for spec in hard} == {"hard"}
    challenge = [spec for task in TASK_NAMES for spec in metadata.episodes(task, "challenge")]
    assert Counter(spec.difficulty for spec in challenge) == {
        "easy": 160,
        "medium": 320,
        "hard": 320,
    }
    known = {
        (s.task, s.seed)
        for task in TASK_NAMES
        for split in metadata.SPLITS
        for s in metadata.episodes(task, split)
    }
    assert not known & {(spec.task, spec.seed) for spec in challenge}
    limits = {
        "test": 1300,
        "hard": 1300,
        "challenge": 1500,
        "ood": 1800,
        "ood:xhard3": 1800,
        "twin:ood": 1800,
        "stress:count=2": 1300,
        "twin": 1300,
        "mine.jsonl": 1800,
    }
    assert {split: step_limit(split) for split in limits} == limits
    env = make_env("StopCube", "ood:xhard3", 2, render=False)
    assert env.max_steps == 1800
    env.close()
    with pytest.raises(UserError, match="no tier 'xhard9'"):
        metadata.episodes("StopCube", "ood:xhard9")
    with pytest.raises(UserError, match="BinFill has no episodes in split 'ood:xhard5'"):
        make_env("BinFill", "ood:xhard5", 0, render=False)
    with pytest.raises(UserError, match="Unknown split 'oood'"):
        metadata.episodes("BinFill", "oood")


def test_values_become_goals() -> None:
    goals = {}
    for task, episode in (("PickXtimes", 49), ("StopCube", 49), ("BinFill", 0), ("VideoUnmask", 49),
                          ("VideoPlaceButton", 49), ("VideoPlaceOrder", 49)):  # fmt: skip
        with scene(task, episode) as env:
            goals[task] = env.goals()[0]
    assert "repeating this action eight times" in goals["PickXtimes"]
    assert goals["StopCube"].endswith("for the tenth time")
    assert goals["BinFill"].startswith("put two red cubes, one blue cube and three green cubes")
    picks = ("blue", "next", "red", "finally", "green")
    assert [goals["VideoUnmask"].find(word) for word in picks] == sorted(
        goals["VideoUnmask"].find(w) for w in picks
    )
    assert goals["VideoPlaceButton"].endswith("last placed before the button was pressed")
    assert goals["VideoPlaceOrder"].endswith("on the second target it was previously placed on")


def test_sub_tasks_that_only_ood_has() -> None:
    with scene("ButtonUnmaskSwap", 49) as env:
        assert texts(env)[2] == "wait for the containers to finish swapping"
        assert env.swapped_after == 64 + 33 * 5  # type: ignore[attr-defined]
        assert [choice.action for choice in env.choices()].count("wait") == 1
    with scene("PickHighlight") as env:
        assert texts(env)[0] == texts(env)[-1] == "press the button"
        assert texts(env)[1:3] == [
            "pick up the first highlighted cube",
            "place the cube onto the table",
        ]
        assert len(texts(env)) == 2 + 2 * 4
    for task, count in (("VideoPlaceButton", 1), ("VideoPlaceOrder", 2)):
        with scene(task) as env:
            assert (
                texts(env, video=True).count("put the cube back to its original position") == count
            )
            assert "drop the cube onto table" not in texts(env, video=True)
    with scene("VideoRepick", 49) as env:
        assert texts(env, video=True).count("static") == 7
    with scene("VideoUnmask", 3, "hard") as env:
        assert not env.tier and "finish" not in " ".join(texts(env))


def test_outer_containers_hide_cubes_and_may_not_be_lifted() -> None:
    with scene("VideoUnmaskSwap", 49) as env:
        names = {thing.name for thing in env.things}
        assert {"distractor_bin_3", "distractor_cube_0_magenta", "distractor_cube_1_cyan"} <= names
        outer = next(thing for thing in env.things if thing.name == "distractor_bin_0")
        home, inner = outer.position.copy(), env.containers[0]  # type: ignore[attr-defined]
        env.before_physics(0)
        assert outer.position[0] > 15 < inner.position[0] and not np.allclose(
            outer.position, inner.position
        )
        env.before_physics(COVER_STEPS // 2)
        np.testing.assert_allclose(outer.position, home, atol=1e-6)
        pick = next(subtask for subtask in env.progress.subtasks if subtask.pick)
        assert pick.failed is not None and not pick.failed()
        outer.move_to(type(outer.pose)([*home[:2], 0.3], outer.pose.q))
        assert pick.failed()


def test_planned_swaps_exchange_the_pairs_of_the_row() -> None:
    spec = metadata.episode("VideoUnmaskSwap", "ood", 49)
    with scene("VideoUnmaskSwap", 49) as env:
        assert spec.row is not None
        containers = env.containers  # type: ignore[attr-defined]
        places = [thing.position[:2].copy() for thing in containers]
        order = list(range(len(places)))
        for a, b in spec.row["spec"]["actions"]["swap_pairs"]:
            order[a], order[b] = order[b], order[a]
        for k in range(COVER_STEPS, env.swapped_after + 1):  # type: ignore[attr-defined]
            env.before_physics(k)
        for i, thing in enumerate(containers):
            np.testing.assert_allclose(thing.position[:2], places[order[i]], atol=1e-5)


def test_a_distractor_cube_is_a_wrong_cube() -> None:
    with scene("PickXtimes", 40) as env:
        distractors: list[Any] = env.distractors  # type: ignore[attr-defined]
        assert [cube.colour for cube in distractors] == ["yellow", "cyan", "magenta"]
        assert set(distractors) <= set(env.choices()[0].candidates or ())


@pytest.mark.parametrize("task", slow_or_nightly(TASK_NAMES, SLOW_TASKS.__contains__))
def test_the_demonstrator_solves_the_first_row(task: str) -> None:
    env = make_task(task, render=False, **metadata.episode(task, "ood", 0).options)
    result = Recorder(env, render=False).record()
    env.close()
    assert result.success, result.error
