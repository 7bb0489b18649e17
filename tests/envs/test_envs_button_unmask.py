"""ButtonUnmask: layout, what counts while the button is pressed, success and failure."""

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_unmask import lift, make, names, push_down, released, skip_place, texts, wait, yaw_of
from mme_vla.envs.scene.placement import CONTAINER_HALF, TRIALS, Draws, Region, button_box
from mme_vla.envs.tasks.button_unmask import ButtonUnmask


@pytest.fixture(scope="module")
def hard() -> Iterator[ButtonUnmask]:
    env = make(ButtonUnmask, 8300, "hard")
    yield env
    env.close()


@pytest.mark.parametrize(
    ("seed", "difficulty", "counts"),
    [
        (1, "easy", {3}),
        (2, "easy", {3}),
        (3, "medium", {5}),
        (4, "medium", {5}),
        (6, "hard", {4, 5, 6}),
        (7, "hard", {4, 5, 6}),
    ],
)
def test_button_then_containers_then_colours_come_from_the_stream(seed, difficulty, counts):
    env = make(ButtonUnmask, seed, difficulty)
    stream = Draws(seed)
    offset = (stream.uniforms(2).numpy() - 0.5) * 0.1
    np.testing.assert_allclose(env.button.pose.p[:2], np.array([-0.2, 0]) + offset, atol=1e-6)
    for container in env.containers:
        assert skip_place(stream, Region((0, 0), 0.2), container) == pytest.approx(yaw_of(container), abs=1e-6)
        assert button_box(env.button).distance(container.initial_pose.p[:2]) >= CONTAINER_HALF + 0.04 - 1e-6
    if difficulty == "hard":  # one more found no place
        for _ in range(TRIALS):
            Region((0, 0), 0.2).place(stream, CONTAINER_HALF)
    assert len(env.containers) in counts and env.colours == names(stream)
    env.close()


def test_containers_come_down_while_there_is_time_to_press(hard):
    hard.reset()
    assert hard.progress.current.text == "press the button" and not hard.progress.current.video
    wait(hard, 32)
    assert min(container.position[0] for container in hard.containers) > 9
    wait(hard, 1)
    assert max(container.position[0] for container in hard.containers) < 0.2


def test_button_and_both_containers_are_success(hard):
    hard.reset()
    wait(hard, 40)
    assert hard.progress.index == 0
    assert push_down(hard, hard.button) == (False, False) and hard.progress.index == 1
    lift(hard, hard.containers[0])
    hard.containers[0].restore()
    wait(hard)
    assert hard.progress.index == 3
    assert lift(hard, hard.containers[1]) == (True, False)


def test_a_container_lifted_before_the_press_fails_only_if_it_is_wrong_and_still_up(hard):
    hard.reset()
    wait(hard, 40)
    assert lift(hard, hard.containers[1]) == (False, False)
    hard.containers[1].restore()
    push_down(hard, hard.button)
    assert wait(hard) == (False, False)

    hard.reset()
    wait(hard, 40)
    push_down(hard, hard.button)
    assert lift(hard, hard.containers[1]) == (False, True)


@pytest.mark.parametrize("stage", [2, 3])
def test_another_container_fails_after_the_first_pick_too(hard, stage):
    hard.reset()
    wait(hard, 40)
    push_down(hard, hard.button)
    lift(hard, hard.containers[0])
    if stage == 3:
        hard.containers[0].restore()
        wait(hard)
    assert hard.progress.index == stage
    assert lift(hard, hard.containers[2]) == (False, True)


def test_a_reset_releases_the_button(hard):
    push_down(hard, hard.button)
    hard.reset()
    assert hard.button.depth == 0
    released(hard, hard.button)
    assert hard.progress.index == 0


def test_texts_goals_and_choices(hard):
    first, second, _ = hard.colours
    assert texts(hard) == [
        ("press the button", "press the button at <>", "a"),
        (f"pick up the container that hides the {first} cube",
         f"pick up the container at <> that hides the {first} cube", "b"),
        ("put down the container", "put down the container", "c"),
        (f"pick up the container that hides the {second} cube",
         f"pick up the container at <> that hides the {second} cube", "b"),
    ]  # fmt: skip
    assert hard.goals() == [
        f"first press the button, then pick up the container hiding the {first} cube, "
        f"finally pick up another container hiding the {second} cube"
    ]
    assert [(option.label, option.action, option.needs_point) for option in hard.choices()] == [
        ("a", "press the button", False),
        ("b", "pick up the container", True),
        ("c", "put down the container", False),
    ]


@pytest.mark.parametrize("seed", [8303, 8304, 8305])
def test_the_pick_that_recovery_fails_has_a_separate_stream(seed):
    env = make(ButtonUnmask, seed, "hard", recovery="z")
    stream = Draws(seed)
    stream.integer(1, 6)
    assert env.failed_pick == stream.integer(0, 2)
    env.close()


def test_easy_and_medium_ask_for_one_container():
    env = make(ButtonUnmask, 8600, "medium")
    assert len(env.progress.subtasks) == 2
    assert env.goals() == [f"first press the button, then pick up the container hiding the {env.colours[0]} cube"]
    env.close()
