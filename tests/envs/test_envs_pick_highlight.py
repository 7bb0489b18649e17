"""PickHighlight: layout, when the highlights are shown, what counts as picked, and what fails."""

from collections.abc import Iterator

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_cubes import COLOURS, Hand, least_distance, read_button, read_cube
from helpers.env_unmask import make, push_down, released, texts, wait
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.pick_highlight import PickHighlight


@pytest.fixture(scope="module")
def two() -> Iterator[PickHighlight]:
    env = make(PickHighlight, 12600, "medium")
    yield env
    env.close()


@pytest.fixture
def hand(two: PickHighlight, monkeypatch: pytest.MonkeyPatch) -> Hand:
    two.reset()
    return Hand(two, monkeypatch)


@pytest.mark.parametrize(
    ("seed", "difficulty", "cubes", "goals"),
    [(1, "easy", 3, 1), (2, "easy", 3, 1), (3, "medium", 4, 2), (4, "medium", 4, 2), (5, "hard", 6, 3),
     (6, "hard", 6, 3)],
)  # fmt: skip
def test_everything_comes_from_the_stream_in_order(seed, difficulty, cubes, goals):
    env = make(PickHighlight, seed, difficulty)
    stream = Draws(seed)
    read_button(stream, env.button, (-0.2, 0), (0.1, 0.4))
    assert len(env.cubes) == cubes
    for cube in env.cubes:
        assert cube.colour == COLOURS[stream.integer(0, 3)]
        read_cube(stream, Region((-0.1, 0), 0.2), cube)
    assert env.goal_cubes == [env.cubes[i] for i in stream.permutation(cubes)[:goals]]
    assert least_distance(env.cubes) >= 0.06
    env.close()


def test_highlights_lie_under_the_goal_cubes_from_step_10_to_step_100(two):
    two.reset()

    def is_highlighted() -> bool:
        discs = [disc.position for disc in two._discs]
        if all(place[2] < -5 for place in discs):
            return False
        for place, cube in zip(discs, two.goal_cubes, strict=True):
            assert place == pytest.approx(cube.position - [0, 0, 0.01], abs=1e-3)
        return True

    highlighted = []
    for _ in range(110):
        wait(two)
        highlighted.append(is_highlighted())
    assert highlighted == [10 <= k <= 100 for k in range(110)]  # k steps were done before


def test_the_button_and_then_every_goal_cube_are_success(two, hand):
    first, second = two.goal_cubes
    assert push_down(two, two.button) == (False, False) and two.progress.index == 1
    released(two, two.button)
    assert hand.carry(first) == (False, False) and two.progress.index == 2
    assert hand.release() == (False, False) and two.progress.index == 3
    assert hand.carry(second) == (True, False)
    hand.release()
    assert wait(two) == (True, False)


@pytest.mark.parametrize("pressed", [True, False])
def test_the_order_of_the_cubes_does_not_matter_nor_does_the_button(two, hand, pressed):
    if pressed:
        push_down(two, two.button)
    first, second = two.goal_cubes
    assert hand.carry(second) == (False, False)
    hand.release()
    assert hand.carry(second) == (False, False)  # once more is not another one
    hand.release()
    assert hand.carry(first) == (True, False)


def test_another_cube_in_the_hand_fails_once_the_button_was_pressed(two, hand):
    other = next(cube for cube in two.cubes if cube not in two.goal_cubes)
    assert hand.carry(other) == (False, False)
    hand.release()
    push_down(two, two.button)
    assert wait(two) == (False, False)
    assert hand.carry(other) == (False, True)
    hand.release()
    assert wait(two) == (False, True)


def test_another_cube_still_grasped_when_the_button_is_pressed_fails(two, hand):
    other = next(cube for cube in two.cubes if cube not in two.goal_cubes)
    hand.carry(other)
    assert push_down(two, two.button) == (False, False)
    assert hand.carry(other) == (False, True)


def test_texts_of_several_and_of_one(two):
    first, second = (cube.colour for cube in two.goal_cubes)
    assert texts(two) == [
        ("press the button", "press the button at <>", "a"),
        (f"pick up the first highlighted cube, which is {first}",
         f"pick up the first highlighted cube at <>, which is {first}", "b"),
        ("place the cube onto the table", "place the cube onto the table", "c"),
        (f"pick up the second highlighted cube, which is {second}",
         f"pick up the second highlighted cube at <>, which is {second}", "b"),
    ]  # fmt: skip
    env = make(PickHighlight, 7, "easy")
    colour = env.goal_cubes[0].colour
    assert texts(env)[1:] == [
        (f"pick up the highlighted cube, which is {colour}",
         f"pick up the highlighted cube at <>, which is {colour}", "b"),
    ]  # fmt: skip
    env.close()


def test_goals_and_choices(two):
    assert two.goals() == [
        "first press the button, then pick up all cubes that have been highlighteted with white areas on the table",
        "first press the button, then pick up all highlighted cubes, finally press the button again to stop",
    ]
    assert [option.needs_point for option in two.choices()] == [False, True, False]
