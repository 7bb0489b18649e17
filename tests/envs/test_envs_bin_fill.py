"""BinFill: what counts as filled, and everything that fails."""

from collections import Counter

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import sapien

from helpers.env_tasks import COLOURS, Flags, Hand, push_down, texts, wait
from mme_vla.envs.scene.objects import Cube
from mme_vla.envs.tasks.bin_fill import BinFill

SCENE = 1  # seed of a scene whose cubes are all there from the start

SCENE = (BinFill, 1, "hard")  # whose cubes are all there from the start


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
    assert env.progress.index == 2 and cube.position[0] > 9 and env.filled == Counter({cube.colour: 1})


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


def test_texts_and_goals(env, monkeypatch):
    colour = next(colour for colour in env.order if env.goal[colour])
    assert texts(env)[:2] + texts(env)[-1:] == [
        (f"pick up the first {colour} cube", f"pick up the first {colour} cube at <>", "a"),
        ("put it into the bin", "put it into the bin at <>", "b"),
        ("press the button", "press the button at <>", "c"),
    ]
    assert len(texts(env)) == 2 * env.goal.total() + 1
    monkeypatch.setattr(env, "goal", Counter(green=2, blue=1))
    assert env.goals() == [
        f"put one blue cube and two green cubes into the bin{end} press the button to stop"
        for end in (", then", " and")
    ]
    monkeypatch.setattr(env, "goal", Counter(green=2, blue=1, red=1))
    assert env.goals()[0].startswith("put one red cube, one blue cube and two green cubes into the bin, then press")
    assert [option.needs_point for option in env.choices()] == [True, False, False]
