"""ButtonUnmaskSwap: layout, the two buttons in either order, success and failure."""

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_unmask import lift, make, names, push_down, released, skip_place, texts, under, wait, yaw_of
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.button_unmask_swap import ButtonUnmaskSwap


@pytest.fixture(scope="module")
def hard() -> Iterator[ButtonUnmaskSwap]:
    env = make(ButtonUnmaskSwap, 7300, "hard")
    yield env
    env.close()


@pytest.mark.parametrize("difficulty", ["easy", "medium", "hard"])
@pytest.mark.parametrize("seed", [1, 2])
def test_everything_comes_from_the_stream_in_order(seed, difficulty):
    env = make(ButtonUnmaskSwap, seed, difficulty)
    stream = Draws(seed)
    for button, y in ((env.left, -0.1), (env.right, 0.1)):
        offset = (stream.uniforms(2).numpy() - 0.5) * 0.05
        np.testing.assert_allclose(button.pose.p[:2], np.array([-0.2, y]) + offset, atol=1e-6)
    o = [0.1 * stream.uniform() for _ in range(8)]
    on_line = stream.integer(0, 2)
    anchors = [(0.0, -0.1 + o[0]), (0.0, 0.1 + o[0]), (0.1, 0.1 + o[1]), (0.1, -0.1 + o[1])]
    if difficulty == "easy":
        anchors = [(-0.05 + o[2], -0.15), (-0.05 + o[3], 0.15), (0.05 + o[4], 0.0)]
        if on_line:
            anchors = [(-0.05 + o[5], -0.15), (-0.05 + o[6], 0.15), (-0.05 + o[7], 0.0)]
    for anchor, container in zip(anchors, env.containers, strict=True):
        assert skip_place(stream, Region(anchor, 0.07), container) == pytest.approx(yaw_of(container), abs=1e-6)
    assert env.colours == names(stream)
    env.close()


@pytest.mark.parametrize("order", ["left first", "right first"])
def test_buttons_may_be_pressed_in_either_order_but_both_must_be(hard, order):
    hard.reset()
    wait(hard, 40)
    first, second = (hard.left, hard.right) if order == "left first" else (hard.right, hard.left)
    push_down(hard, first)
    assert hard.progress.index == 1
    released(hard, first)
    push_down(hard, first)
    assert hard.progress.index == 1
    push_down(hard, second)
    assert hard.progress.index == 2
    hard.reset()
    wait(hard, 40)
    push_down(hard, second)
    assert hard.progress.index == 1


def test_covering_and_swapping_run_on_the_clock_of_the_execution(hard):
    hard.reset()
    before = [container.initial_pose.p[:2] for container in hard.containers]
    wait(hard, 65)
    assert min(cube.position[0] for cube in hard.cubes) > 9
    wait(hard, hard.swapped_after - 55)
    after = [container.position[:2] for container in hard.containers]
    # Each stands where one stood before.
    assert sorted(min(range(len(before)), key=lambda i: np.linalg.norm(before[i] - place)) for place in after) == list(
        range(len(before))
    )
    assert under(hard.cubes, hard.over_cubes)
    assert hard.progress.index == 0


def test_success_and_failure(hard):
    hard.reset()
    first, second = hard.over_cubes[:2]
    wait(hard, hard.swapped_after + 5)
    assert lift(hard, second) == (False, False)  # nothing fails before both buttons were pressed
    second.move_to(second.initial_pose)
    push_down(hard, hard.right)
    assert lift(hard, second) == (False, False)
    second.move_to(second.initial_pose)
    push_down(hard, hard.left)
    assert hard.progress.index == 2
    assert lift(hard, second) == (False, True)
    second.move_to(second.initial_pose)
    assert lift(hard, first) == (False, False) and hard.progress.index == 3
    first.move_to(first.initial_pose)
    wait(hard)
    assert hard.progress.index == 4
    assert lift(hard, second) == (True, False)


def test_texts_goals_and_choices(hard):
    first, second, _ = hard.colours
    assert texts(hard) == [
        ("press the first button", "press the first button at <>", "a"),
        ("press the second button", "press the second button at <>", "b"),
        (f"pick up the container that hides the {first} cube",
         f"pick up the container at <> that hides the {first} cube", "c"),
        ("put down the container", "put down the container", "d"),
        (f"pick up the container that hides the {second} cube",
         f"pick up the container at <> that hides the {second} cube", "c"),
    ]  # fmt: skip
    assert not any(step.video for step in hard.progress.subtasks)
    assert [step.targets[0] for step in hard.progress.subtasks[:2]] == [hard.right, hard.left]
    assert hard.goals() == [
        f"first press both buttons on the table, then pick up the container hiding the {first} cube, "
        f"finally pick up another container hiding the {second} cube"
    ]
    assert [(option.label, option.action, option.needs_point) for option in hard.choices()] == [
        ("a", "press the first button", False),
        ("b", "press the second button", False),
        ("c", "pick up the container", True),
        ("d", "put down the container", False),
    ]
