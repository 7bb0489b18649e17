"""VideoUnmaskSwap: layout, how containers change places, success and failure."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_unmask import lift, make, names, skip_place, texts, under, wait, yaw_of
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.video_unmask_swap import VideoUnmaskSwap

TRIANGLE = [(-0.05, -0.1), (-0.05, 0.1), (0.1, 0.0)]
LINE = [(0.0, -0.15), (0.0, 0.15), (0.0, 0.0)]
SQUARE = [(-0.05, -0.1), (-0.05, 0.1), (0.1, 0.1), (0.1, -0.1)]
RANGES = {"easy": (3, (1, 2), (1, 2)), "medium": (4, (1, 2), (1, 1)), "hard": (4, (2, 3), (2, 2))}


@pytest.fixture(scope="module")
def hard() -> Iterator[VideoUnmaskSwap]:
    env = make(VideoUnmaskSwap, 5300, "hard")  # three swaps
    yield env
    env.close()


@pytest.mark.parametrize("difficulty", RANGES)
@pytest.mark.parametrize("seed", [1, 2])
def test_everything_comes_from_the_streams_in_order(seed, difficulty):
    env = make(VideoUnmaskSwap, seed, difficulty, recovery="z")
    count, swaps, picks = RANGES[difficulty]
    stream = Draws(seed)
    assert (env.swap_count, env.pick_count) == (
        stream.integer(swaps[0], swaps[1] + 1),
        stream.integer(picks[0], picks[1] + 1),
    )
    stream = Draws(seed)
    on_line, angle = stream.integer(0, 2), 180 * stream.uniform()
    cos, sin = math.cos(angle), math.sin(angle)
    anchors = SQUARE if count == 4 else LINE if on_line else TRIANGLE
    assert len(env.containers) == count
    for (x, y), container in zip(anchors, env.containers, strict=True):
        region = Region((cos * x - sin * y, sin * x + cos * y), 0.07)
        assert skip_place(stream, region, container) == pytest.approx(yaw_of(container), abs=1e-6)
    assert env.colours == names(stream)
    assert env.over_cubes == [env.containers[i] for i in stream.permutation(3)]
    stream.integer(0, 3)
    first = stream.permutation(3)[:2]
    remaining = [i for i in range(count) if i not in first]
    initiators = [*first, remaining[stream.integer(0, len(remaining))]][: env.swap_count]
    assert env.initiators == [env.containers[i] for i in initiators]
    assert env.failed_pick == stream.integer(0, env.pick_count)
    env.close()


def test_two_containers_change_places_at_a_time_and_the_others_stand_still(hard):
    hard.reset()
    wait(hard, 65)
    for i, initiator in enumerate(hard.initiators):
        start = [container.pose for container in hard.containers]
        nearest = min(
            (c for c in hard.containers if c is not initiator),
            key=lambda c: np.linalg.norm(c.position[:2] - initiator.position[:2]),
        )
        wait(hard, 25)
        others = [c for c in hard.containers if c not in (initiator, nearest)]
        for container in others:
            assert np.abs(container.position[:2] - start[hard.containers.index(container)].p[:2]).max() < 2e-3
        middle = (start[hard.containers.index(initiator)].p + start[hard.containers.index(nearest)].p)[:2] / 2
        aside = [np.linalg.norm(c.position[:2] - middle) for c in (initiator, nearest)]
        assert aside == pytest.approx([0.07, 0.07], abs=3e-3)
        wait(hard, 25)
        a, b = hard.containers.index(initiator), hard.containers.index(nearest)
        for mine, other in ((a, b), (b, a)):
            now = hard.containers[mine].pose
            assert np.abs(now.p[:2] - start[other].p[:2]).max() < 6e-3, i
            assert abs(float(now.q @ start[other].q)) > 0.9999


def test_cubes_are_away_while_containers_move_and_lie_under_the_same_ones_then(hard):
    hard.reset()
    wait(hard, 64)
    assert under(hard.cubes, hard.over_cubes)
    wait(hard, 1)
    assert min(cube.position[0] for cube in hard.cubes) > 9
    wait(hard, hard.swapped_after - 65)
    assert min(cube.position[0] for cube in hard.cubes) > 9
    wait(hard, 10)
    assert under(hard.cubes, hard.over_cubes) and [cube.colour for cube in hard.cubes] == hard.colours


def test_the_video_lasts_until_the_last_swap_has_ended(hard):
    hard.reset()
    assert hard.swapped_after == 64 + 50 * 3
    wait(hard, hard.swapped_after - 1)
    assert hard.progress.index == 0
    wait(hard)
    assert hard.progress.index == 1


def test_success_and_failure(hard):
    hard.reset()
    first, second = hard.over_cubes[:2]
    wait(hard, hard.swapped_after + 10)
    back = first.pose
    assert lift(hard, first) == (False, False)
    assert lift(hard, second) == (False, True)
    second.move_to(second.initial_pose)
    assert wait(hard) == (False, False)  # judged anew at each step
    first.move_to(back)
    wait(hard)
    assert hard.progress.index == 3
    empty = next(container for container in hard.containers if container not in hard.over_cubes)
    assert lift(hard, empty) == (False, True)
    empty.move_to(empty.initial_pose)
    assert lift(hard, second) == (True, False)


def test_texts_goals_and_choices(hard):
    first, second, _ = hard.colours
    assert [text for text, _, _ in texts(hard)] == [
        "static",
        f"pick up the container that hides the {first} cube",
        "put down the container",
        f"pick up the container that hides the {second} cube",
    ]
    assert [choice for *_, choice in texts(hard)] == ["", "a", "b", "a"]
    assert [step.video for step in hard.progress.subtasks] == [True, False, False, False]
    assert [step.targets[0] for step in hard.progress.subtasks if step.pick] == hard.over_cubes[:2]
    assert hard.goals() == [
        f"watch the video carefully, then pick up the container hiding the {first} cube, "
        f"finally pick up another container hiding the {second} cube"
    ]
    assert [(option.label, option.needs_point) for option in hard.choices()] == [("a", True), ("b", False)]
