"""BinFill: what counts as filled, and everything that fails."""

from collections import Counter
from collections.abc import Iterator

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import sapien

from helpers.env_cubes import COLOURS, Flags, Hand
from helpers.env_unmask import make, push_down, texts, wait
from mme_vla.envs.scene.objects import Cube
from mme_vla.envs.tasks.bin_fill import BinFill

SCENE = 1  # seed of a scene whose cubes are all there from the start


@pytest.fixture(scope="module")
def fill() -> Iterator[BinFill]:
    env = make(BinFill, SCENE, "hard")
    yield env
    env.close()


@pytest.fixture
def hand(fill: BinFill, monkeypatch: pytest.MonkeyPatch) -> Hand:
    fill.reset()
    return Hand(fill, monkeypatch)


def put(env: BinFill, hand: Hand, cube: Cube) -> Flags:
    hand.carry(cube)
    return hand.release(env.board.position)


def put_all(env: BinFill, hand: Hand) -> None:
    for colour in env.order:
        for cube in env.cubes[colour][: env.goal[colour]]:
            assert put(env, hand, cube) == (False, False)


def test_the_right_numbers_then_the_button_are_success(fill, hand):
    put_all(fill, hand)
    assert fill.progress.current.text == "press the button" and fill.filled == fill.goal
    assert push_down(fill, fill.button) == (True, False)
    assert wait(fill) == (True, False)


def test_a_cube_in_the_bin_leaves_the_table(fill, hand):
    cube = fill.cubes[fill.order[-1]][0]  # any cube will do, whatever is asked for
    put(fill, hand, cube)
    assert fill.progress.index == 2 and cube.position[0] > 9 and fill.filled == Counter({cube.colour: 1})


def test_a_cube_beside_the_bin_or_near_the_gripper_is_not_filled_in(fill, hand, monkeypatch):
    cube, (x, y, _) = fill.all_cubes()[0], fill.board.position
    hand.carry(cube)
    hand.release((x, y + 0.055))
    assert fill.progress.index == 1
    monkeypatch.setattr(type(fill), "tcp_pose", property(lambda env: sapien.Pose(cube.position)))
    hand.carry(cube)
    hand.release((x, y))
    assert fill.progress.index == 1
    monkeypatch.undo()
    wait(fill)
    assert fill.progress.index == 2


@pytest.mark.parametrize("stage", [0, 1])
def test_the_button_before_its_time_fails_and_stays_failed(fill, hand, stage):
    if stage:
        hand.carry(fill.all_cubes()[0])
    assert push_down(fill, fill.button) == (False, True)
    fill.button.restore()
    assert wait(fill) == (False, True)


def test_a_wrong_colour_fails_only_when_the_button_is_due(fill, hand):
    colour_ = next(colour for colour in COLOURS if fill.goal[colour])
    wrong = next(colour for colour in COLOURS if colour != colour_)
    cubes = [cube for c in COLOURS for cube in fill.cubes[c][: fill.goal[c]]]
    cubes[cubes.index(fill.cubes[colour_][0])] = fill.cubes[wrong][fill.goal[wrong]]
    for cube in cubes:
        assert put(fill, hand, cube) == (False, False)
    assert wait(fill) == (False, True)


def test_a_surplus_cube_fails_when_the_button_is_due(fill, hand):
    put_all(fill, hand)
    assert wait(fill) == (False, False)
    left = next(cube for cube in fill.all_cubes() if cube.position[0] < 1)
    assert put(fill, hand, left) == (False, True)


def test_texts_and_goals(fill, monkeypatch):
    colour = next(colour for colour in fill.order if fill.goal[colour])
    assert texts(fill)[:2] + texts(fill)[-1:] == [
        (f"pick up the first {colour} cube", f"pick up the first {colour} cube at <>", "a"),
        ("put it into the bin", "put it into the bin at <>", "b"),
        ("press the button", "press the button at <>", "c"),
    ]
    assert len(texts(fill)) == 2 * fill.goal.total() + 1
    monkeypatch.setattr(fill, "goal", Counter(green=2, blue=1))
    assert fill.goals() == [
        f"put one blue cube and two green cubes into the bin{end} press the button to stop"
        for end in (", then", " and")
    ]
    monkeypatch.setattr(fill, "goal", Counter(green=2, blue=1, red=1))
    assert fill.goals()[0].startswith("put one red cube, one blue cube and two green cubes into the bin, then press")
    assert [option.needs_point for option in fill.choices()] == [True, False, False]
