"""BinFill: when cubes appear, what counts as filled, and everything that fails."""

from collections import Counter

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import sapien

from helpers.env_tasks import COLOURS, Flags, Hand, push_down, wait
from mme_vla.envs.robomme.scene.objects import Cube
from mme_vla.envs.robomme.tasks.bin_fill import BinFill

STREAMING, STATIC = 4, 1  # seeds: cubes appear one after another, or are all there from the start

SCENE = (BinFill, STATIC, "hard")


def put(env: BinFill, hand: Hand, cube: Cube) -> Flags:
    hand.carry(cube)
    return hand.release(env.board.position)


def put_all(env: BinFill, hand: Hand) -> None:
    for colour in env.order:
        for cube in env.cubes[colour][: env.goal[colour]]:
            assert put(env, hand, cube) == (False, False)


def test_the_right_numbers_then_the_button_are_success(env, hand):
    put_all(env, hand)
    assert env.progress.current.text == "press the button" and env.filled == env.goal
    assert push_down(env, env.button) == (True, False)
    assert wait(env) == (True, False)


def test_a_cube_in_the_bin_leaves_the_table(env, hand):
    cube = env.cubes[env.order[-1]][0]  # any cube will do, whatever is asked for
    put(env, hand, cube)
    assert (
        env.progress.index == 2 and cube.position[0] > 9 and env.filled == Counter({cube.colour: 1})
    )


def test_a_cube_beside_the_bin_or_near_the_gripper_is_not_filled_in(env, hand, monkeypatch):
    cube, (x, y, _) = env.all_cubes()[0], env.board.position
    hand.carry(cube)
    hand.release((x, y + 0.055))
    assert env.progress.index == 1
    monkeypatch.setattr(type(env), "tcp_pose", property(lambda env: sapien.Pose(cube.position)))
    hand.carry(cube)
    hand.release((x, y))
    assert env.progress.index == 1
    monkeypatch.undo()
    wait(env)
    assert env.progress.index == 2


@pytest.mark.parametrize("stage", [0, 1])
def test_the_button_before_its_time_fails_and_stays_failed(env, hand, stage):
    if stage:
        hand.carry(env.all_cubes()[0])
    assert push_down(env, env.button) == (False, True)
    env.button.restore()
    assert wait(env) == (False, True)


def test_a_wrong_colour_fails_only_when_the_button_is_due(env, hand):
    colour_ = next(colour for colour in COLOURS if env.goal[colour])
    wrong = next(colour for colour in COLOURS if colour != colour_)
    cubes = [cube for c in COLOURS for cube in env.cubes[c][: env.goal[c]]]
    cubes[cubes.index(env.cubes[colour_][0])] = env.cubes[wrong][env.goal[wrong]]
    for cube in cubes:
        assert put(env, hand, cube) == (False, False)
    assert wait(env) == (False, True)


def test_a_surplus_cube_fails_when_the_button_is_due(env, hand):
    put_all(env, hand)
    assert wait(env) == (False, False)
    left = next(cube for cube in env.all_cubes() if cube.position[0] < 1)
    assert put(env, hand, left) == (False, True)


def test_streaming_cubes_appear_50_steps_after_each_other(build_task):
    env = build_task(BinFill, STREAMING, "easy")
    cubes = env.all_cubes()

    def present() -> list[bool]:
        return [bool(cube.position[0] < 1) for cube in cubes]

    wait(env, 50)
    assert present() == [True] + [False] * (len(cubes) - 1)
    wait(env)
    assert present() == [True] * 2 + [False] * (len(cubes) - 2)
    wait(env, 50)
    assert present() == [True] * 3 + [False] * (len(cubes) - 3)
    assert cubes[2].position == pytest.approx(cubes[2].initial_pose.p, abs=1e-3)
