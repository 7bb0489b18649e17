"""PickHighlight: layout, when the highlights are shown, what counts as picked, and what fails."""

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import COLOURS, least_distance, push_down, read_button, read_cube, released, wait
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.pick_highlight import PickHighlight

SCENE = (PickHighlight, 12600, "medium")  # two goal cubes


@pytest.mark.parametrize(
    ("seed", "difficulty", "cubes", "goals"),
    [(1, "easy", 3, 1), (2, "easy", 3, 1), (3, "medium", 4, 2), (4, "medium", 4, 2), (5, "hard", 6, 3),
     (6, "hard", 6, 3)],
)  # fmt: skip
def test_everything_comes_from_the_stream_in_order(made, seed, difficulty, cubes, goals):
    env = made(PickHighlight, seed, difficulty)
    stream = Draws(seed)
    read_button(stream, env.button, (-0.2, 0), (0.1, 0.4))
    assert len(env.cubes) == cubes
    for cube in env.cubes:
        assert cube.colour == COLOURS[stream.integer(0, 3)]
        read_cube(stream, Region((-0.1, 0), 0.2), cube)
    assert env.goal_cubes == [env.cubes[i] for i in stream.permutation(cubes)[:goals]]
    assert least_distance(env.cubes) >= 0.06


def test_highlights_lie_under_the_goal_cubes_from_step_10_to_step_100(env):

    def is_highlighted() -> bool:
        discs = [disc.position for disc in env._discs]
        if all(place[2] < -5 for place in discs):
            return False
        for place, cube in zip(discs, env.goal_cubes, strict=True):
            assert place == pytest.approx(cube.position - [0, 0, 0.01], abs=1e-3)
        return True

    highlighted = []
    for _ in range(110):
        wait(env)
        highlighted.append(is_highlighted())
    assert highlighted == [10 <= k <= 100 for k in range(110)]  # k steps were done before


def test_the_button_and_then_every_goal_cube_are_success(env, hand):
    first, second = env.goal_cubes
    assert push_down(env, env.button) == (False, False) and env.progress.index == 1
    released(env, env.button)
    assert hand.carry(first) == (False, False) and env.progress.index == 2
    assert hand.release() == (False, False) and env.progress.index == 3
    assert hand.carry(second) == (True, False)
    hand.release()
    assert wait(env) == (True, False)


@pytest.mark.parametrize("pressed", [True, False])
def test_the_order_of_the_cubes_does_not_matter_nor_does_the_button(env, hand, pressed):
    if pressed:
        push_down(env, env.button)
    first, second = env.goal_cubes
    assert hand.carry(second) == (False, False)
    hand.release()
    assert hand.carry(second) == (False, False)  # once more is not another one
    hand.release()
    assert hand.carry(first) == (True, False)


def test_another_cube_in_the_hand_fails_once_the_button_was_pressed(env, hand):
    other = next(cube for cube in env.cubes if cube not in env.goal_cubes)
    assert hand.carry(other) == (False, False)
    hand.release()
    push_down(env, env.button)
    assert wait(env) == (False, False)
    assert hand.carry(other) == (False, True)
    hand.release()
    assert wait(env) == (False, True)


def test_another_cube_still_grasped_when_the_button_is_pressed_fails(env, hand):
    other = next(cube for cube in env.cubes if cube not in env.goal_cubes)
    hand.carry(other)
    assert push_down(env, env.button) == (False, False)
    assert hand.carry(other) == (False, True)
