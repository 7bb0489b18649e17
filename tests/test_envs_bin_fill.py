"""BinFill: layout, cubes that come later, what counts as filled, and everything that fails."""

from collections import Counter
from collections.abc import Iterator

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import numpy as np
import sapien
from envs_cubes import COLOURS, Flags, Hand, least_distance, read_button, read_cube, steps_of_demonstration
from envs_unmask import make, push_down, texts, wait

from mme_vla.envs.draws import Draws
from mme_vla.envs.objects import Cube
from mme_vla.envs.placement import Region
from mme_vla.envs.tasks.bin_fill import BinFill

STREAMING, STATIC = 4, 1  # seeds
TABLE = Region((-0.1, 0), (0.2, 0.25))
AVAILABLE = {"easy": 1, "medium": 2, "hard": 3}
GOAL_COLOURS = {"easy": (1, 1), "medium": (1, 2), "hard": (2, 3)}
GOAL_CUBES = {"easy": (1, 3), "medium": (2, 4), "hard": (3, 5)}
CUBES = {"easy": (4, 6), "medium": (8, 10), "hard": (10, 12)}


@pytest.fixture(scope="module")
def fill() -> Iterator[BinFill]:
    env = make(BinFill, STATIC, "hard")
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


@pytest.mark.parametrize(("seed", "difficulty"), [(s, d) for d in AVAILABLE for s in (STATIC, STREAMING)])
def test_everything_comes_from_the_stream_in_order(seed, difficulty):
    env = make(BinFill, seed, difficulty)
    stream = Draws(seed)
    assert env.streaming == (stream.integer(0, 2) == 0) == (seed == STREAMING)
    read_button(stream, env.button, (-0.2, 0), (0.1, 0.4))
    x, y, yaw = (stream.uniform() for _ in range(3))
    turn = np.deg2rad(-20 + 40 * yaw) / 2
    expected = [-0.05 + 0.2 * x, -0.2 + 0.4 * y, 0.025, np.cos(turn), 0, 0, np.sin(turn)]
    np.testing.assert_allclose([*env.board.pose.p, *env.board.pose.q], expected, atol=1e-6)
    pool = [COLOURS[i] for i in stream.permutation(3)][: AVAILABLE[difficulty]]
    colours, total = (
        stream.integer(low, high + 1) for low, high in (GOAL_COLOURS[difficulty], GOAL_CUBES[difficulty])
    )
    goal = Counter(pool[stream.integer(0, colours)] for _ in range(total)) if colours > 1 else Counter(pool[:1] * total)
    assert env.goal == goal and goal.total() == total
    low, high = CUBES[difficulty]
    cubes = stream.integer(low, high + 1)
    spawned = {colour: max(1, goal[colour]) for colour in pool}
    for _ in range(cubes - sum(spawned.values())):
        spawned[pool[stream.integer(0, len(pool)) if len(pool) > 1 else 0]] += 1
    assert {colour: len(env.cubes[colour]) for colour in pool} == spawned
    wanted, indices = [colour for colour in COLOURS for _ in range(spawned.get(colour, 0))], Counter()
    for i in stream.permutation(cubes):
        read_cube(stream, TABLE, env.cubes[wanted[i]][indices[wanted[i]]])
        indices[wanted[i]] += 1
    stream.permutation(3)  # an episode is initialised twice
    assert env.order == [("blue", "red", "green")[i] for i in stream.permutation(3)]
    assert len(env.all_cubes()) == cubes and least_distance(env.all_cubes()) >= 0.04
    env.close()


def test_streaming_cubes_appear_50_steps_after_each_other():
    env = make(BinFill, STREAMING, "easy")
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
    env.close()


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
    asked = next(colour for colour in COLOURS if fill.goal[colour])
    wrong = next(colour for colour in COLOURS if colour != asked)
    cubes = [cube for c in COLOURS for cube in fill.cubes[c][: fill.goal[c]]]
    cubes[cubes.index(fill.cubes[asked][0])] = fill.cubes[wrong][fill.goal[wrong]]
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
        f"put one blue cube and two green cubes into the bin{end} press the button to stop" for end in (", then", " and")
    ]
    monkeypatch.setattr(fill, "goal", Counter(green=2, blue=1, red=1))
    assert fill.goals()[0].startswith("put one red cube, one blue cube and two green cubes into the bin, then press")
    assert [option.needs_point for option in fill.choices()] == [True, False, False]


def test_a_recovery_episode_has_another_order_of_colours():
    env = make(BinFill, STATIC, "hard", recovery="z")
    stream = Draws(0)
    stream.restore(env._drawn)
    picks = env.goal.total()
    stream.permutation(3)
    stream.integer(0, picks)
    assert env.order == [("blue", "red", "green")[i] for i in stream.permutation(3)]
    assert env.failed_pick == stream.integer(0, picks)
    env.close()


def test_a_demonstration_takes_as_long_as_the_official_one():
    env = make(BinFill, 4600, "medium")
    # On other processors the last bits of a motion may decide on a few steps.
    assert steps_of_demonstration(env) == pytest.approx(622, abs=6)
    env.close()
