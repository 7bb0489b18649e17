"""Scenes given as values: the same scene to the last bit, files of scenes, and rows that are
refused.
"""

import contextlib
import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.tiers import ONE_OF_A_SUITE, slow_or_nightly
from mme_vla.envs import metadata
from mme_vla.envs.make import load_tasks, make_env, make_task
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.envs.robomme.scene.placement import SceneError
from mme_vla.envs.task import Task
from mme_vla.errors import UserError

Row = dict[str, Any]
VARIED = [
    ("PickXtimes", "stress:count=2"),
    ("VideoUnmask", "stress:containers=2"),
    ("StopCube", "stress:count=3"),
    ("VideoUnmaskSwap", "stress:swaps=2"),
    ("MoveCube", "stress:delay=12"),
    ("PickHighlight", "twin"),
    ("PickHighlight", "stress:distractors=2"),
    ("VideoRepick", "stress:delay=30"),
]


@pytest.fixture(scope="module", autouse=True)
def _tasks() -> None:
    load_tasks(*TASK_NAMES)


def scene_of(env: Task) -> dict[str, Any]:
    """Where everything stands and what is to be done."""
    env.reset()
    places = {
        thing.name: np.concatenate([thing.pose.p, thing.pose.q]).tobytes() for thing in env.things
    }
    texts = [subtask.text for subtask in env.progress.subtasks]
    return {
        "places": places,
        "texts": texts,
        "goals": env.goals(),
        "choices": [c.action for c in env.choices()],
    }


def check_round_trip(task: str, options: Row) -> None:
    sampled = make_task(task, render=False, **options)
    scene = scene_of(sampled)
    row = json.loads(json.dumps(sampled.scene_values()))
    sampled.close()
    env = make_env(task, row=row, render=False)
    try:
        assert scene_of(env.task) == scene
        assert json.loads(json.dumps(env.scene_values())) == row
    finally:
        env.close()


def row_of(task: str, split: str = "ood", episode: int = 0) -> Row:
    row = metadata.episode(task, split, episode).row
    assert row is not None
    return copy.deepcopy(dict(row))


@pytest.mark.slow
@pytest.mark.parametrize("task", TASK_NAMES)
def test_a_scene_built_from_its_values_is_the_same(task: str) -> None:
    for episode in (0, 2, 3):
        check_round_trip(task, metadata.episode(task, "test", episode).options)
    check_round_trip(task, metadata.episode(task, "ood", 49).options)


@pytest.mark.parametrize("task", slow_or_nightly(TASK_NAMES, lambda task: task in ONE_OF_A_SUITE))
def test_twenty_scenes_built_from_their_values_are_the_same(task: str) -> None:
    built = 0
    for episode in range(50):
        with contextlib.suppress(SceneError):
            # of two published test seeds an object finds no place here
            check_round_trip(task, metadata.episode(task, "test", episode).options)
            built += 1
        if built == 20:
            return
    pytest.fail(f"{built} of 50 scenes can be built")


@pytest.mark.parametrize(("task", "split"), VARIED)
def test_varied_scenes_are_rows_as_well(task: str, split: str) -> None:
    check_round_trip(task, metadata.episode(task, split, 2).options)


def test_a_recovery_demonstration_keeps_its_failed_pick() -> None:
    env = make_task("BinFill", render=False, seed=4000, difficulty="easy", recovery="z")
    env.reset()
    row, failed = env.scene_values(), env.failed_pick
    env.close()
    again = make_env("BinFill", row=row, render=False)
    again.task.reset()
    assert again.task.failed_pick == failed is not None
    again.close()


def test_steps_in_a_scene_from_values_are_the_same() -> None:
    states = []
    row: Row | None = None
    for _ in range(2):
        scene = {"row": row} if row else {}
        env = make_env("VideoUnmaskSwap", "test", 0, render=False, **scene)
        observation, _ = env.reset()
        row = row or env.scene_values()
        action = np.append(observation["joint_state_list"][-1] + 0.02, 1.0)
        for _ in range(5):
            observation, *_ = env.step(action)
        states.append(
            [thing.pose.p.tobytes() + thing.pose.q.tobytes() for thing in env.task.things]
        )
        env.close()
    assert states[0] == states[1]


def test_a_file_of_scenes_is_a_split(tmp_path: Path) -> None:
    path = tmp_path / "scenes.jsonl"
    rows = [
        row_of("PickXtimes", episode=1) | {"note": "a\u2028b"},
        row_of("StopCube"),
        row_of("PickXtimes"),
    ]
    path.write_text(
        "\n".join(json.dumps(row, ensure_ascii=False) for row in rows) + "\n", encoding="utf-8"
    )
    specs = metadata.episodes("PickXtimes", str(path))
    assert [spec.seed for spec in specs] == [rows[0]["seed"], rows[2]["seed"]]
    assert metadata.episodes("MoveCube", str(path)) == []
    env = make_env("PickXtimes", str(path), 1, render=False)
    assert env.max_steps == 1800 and env.difficulty == "xhard1"
    env.close()
    twin = metadata.episode("StopCube", f"twin:{path}", 0)
    assert twin.options["in_view"] and twin.options["row"]["seed"] == rows[1]["seed"]


def put(name: str, value: Any) -> Callable[[Row], None]:
    """Set a value of a row by its path."""

    def change(row: Row) -> None:
        *path, last = name.split(".")
        holder: Any = row["spec"]
        for part in path:
            holder = holder[int(part)] if part.isdigit() else holder[part]
        holder[int(last) if last.isdigit() else last] = value

    return change


def drop(name: str) -> Callable[[Row], None]:
    """Leave a value of a row out."""

    def change(row: Row) -> None:
        *path, last = name.split(".")
        holder = row["spec"]
        for part in path:
            holder = holder[part]
        del holder[last]

    return change


BAD = [
    ("PickXtimes", drop("layout.button_xy"), "layout.button_xy is missing"),
    ("PickXtimes", put("objects.num_repeats", 0), "objects.num_repeats"),
    ("PickXtimes", put("objects.num_repeats", 2.5), "objects.num_repeats"),
    ("PickXtimes", put("objects.target_color", "purple"), "objects.target_color"),
    ("PickXtimes", put("layout.cubes", {"mauve_0": [0, 0, 0]}), "layout.cubes.mauve_0"),
    (
        "PickXtimes",
        put("layout.goal_xy", [float("nan"), 0]),
        r"layout.goal_xy\[0\]=nan must be a number from -2.0 to 2.0",
    ),
    (
        "SwingXtimes",
        put("layout.distractors", {"pink_0": [0.1, 0.1, 0]}),
        "layout.distractors.pink_0",
    ),
    ("StopCube", put("actions.stop_time", 99), "actions.stop_time"),
    ("BinFill", put("layout.slots.1", [0.024, 0.066, 0.6]), "layout.slots"),
    ("BinFill", put("objects.slot_assignment.0", "pink_0"), "objects.slot_assignment"),
    ("VideoUnmask", put("objects.colors", ["red", "green", "pink"]), "objects.colors"),
    ("VideoUnmask", drop("objects.n_picks"), "objects.n_picks is missing"),
    ("VideoUnmask", put("objects.distractors.cube_bins", [0, 40]), "objects.distractors.cube_bins"),
    ("VideoUnmaskSwap", put("objects.n_swaps", 40), "objects.n_swaps"),
    ("VideoUnmaskSwap", put("actions.swap_pairs.0", [0, 9]), "actions.swap_pairs"),
    ("VideoUnmaskSwap", put("actions.swap_pairs.0", [1, 1]), "actions.swap_pairs"),
    ("ButtonUnmaskSwap", drop("layout.buttons_xy"), "layout.buttons_xy.0 is missing"),
    ("VideoRepick", put("objects.target", 12), "objects.target"),
    ("VideoPlaceButton", put("objects.swap_pair_ids", [0, 0]), "objects.swap_pair_ids"),
    ("VideoPlaceOrder", put("objects.which_in_subset", 9), "objects.which_in_subset"),
    ("PickHighlight", put("objects.highlight_ids", [0, 0]), "objects.highlight_ids"),
    ("MoveCube", put("initializations.1.way_idx", 3), "initializations.way_idx"),
    ("InsertPeg", put("initializations.1.pegs.0", [0.1]), "initializations.pegs.0"),
    ("PatternLock", put("actions.path_nodes", [0, 24]), "actions.path_nodes"),
    ("RouteStick", put("actions.turns", ["clockwise"]), "actions.turns"),
]


@pytest.mark.parametrize(
    ("task", "change", "field"), BAD, ids=[f"{task}-{field}" for task, _, field in BAD]
)
def test_a_bad_row_is_refused_with_the_name_of_its_field(
    task: str, change: Callable[[Row], None], field: str
) -> None:
    row = row_of(task)
    change(row)
    with pytest.raises(UserError, match=f"spec.{field}"):
        make_env(task, row=row, render=False).reset()


def test_objects_that_overlap_are_refused_with_both_names() -> None:
    row = row_of("VideoUnmask")
    bins = row["spec"]["layout"]["bins"]
    bins[4] = [bins[2][0] + 0.01, bins[2][1], bins[2][2]]
    with pytest.raises(UserError, match=r"layout\.bins\.4 overlaps spec\.layout\.bins\.2"):
        make_env("VideoUnmask", row=row, render=False)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "line 1 is not valid JSON"),
        ("[" * 100_000, "line 1 is nested too deeply"),
        ('{"task": "PickXtimes", "spec": {}, "seed": ' + "9" * 5000 + "}", "line 1 is not valid"),
        ("[]", "expected an object"),
        ('{"task": "PickXtime", "spec": {}}', "task is 'PickXtime'"),
        ('{"task": "PickXtimes"}', "spec is None"),
        ('{"task": "PickXtimes", "spec": {"lay": {}}}', r"spec\.lay"),
        ('{"task": "PickXtimes", "spec": {}, "seed": -1}', "seed is -1"),
        ('{"task": "PickXtimes", "spec": {}, "difficulty": "hardest"}', "difficulty is 'hardest'"),
        ("", "has no scenes"),
    ],
)
def test_a_bad_line_is_refused_when_the_file_is_read(
    tmp_path: Path, line: str, message: str
) -> None:
    path = tmp_path / "scenes.jsonl"
    path.write_text(line + "\n")
    with pytest.raises(UserError, match=message):
        metadata.episodes("PickXtimes", str(path))


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_of_scenes_may_end_as_on_any_system(tmp_path: Path, end: str) -> None:
    line = '{"task": "PickXtimes", "spec": {}, "tier": "a\u2028b"}'
    path = tmp_path / "scenes.jsonl"
    path.write_bytes(f"{line}{end}{line}{end}".encode())
    assert len(metadata.episodes("PickXtimes", str(path))) == 2
