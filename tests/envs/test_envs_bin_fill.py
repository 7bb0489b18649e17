"""BinFill: the layout, when cubes appear, what counts as filled, and everything that fails."""

from collections import Counter

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import numpy as np
import sapien

from helpers.env_tasks import COLOURS, Flags, Hand, least_distance, push_down, read_button, read_cube, wait
from mme_vla.envs.scene.objects import Cube
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.bin_fill import BinFill

STREAMING, STATIC = 4, 1  # seeds: cubes appear one after another, or are all there from the start
TABLE = Region((-0.1, 0), (0.2, 0.25))
AVAILABLE = {"easy": 1, "medium": 2, "hard": 3}
GOAL_COLOURS = {"easy": (1, 1), "medium": (1, 2), "hard": (2, 3)}
GOAL_CUBES = {"easy": (1, 3), "medium": (2, 4), "hard": (3, 5)}
CUBES = {"easy": (4, 6), "medium": (8, 10), "hard": (10, 12)}

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


@pytest.mark.parametrize(("seed", "difficulty"), [(s, d) for d in AVAILABLE for s in (STATIC, STREAMING)])
def test_everything_comes_from_the_stream_in_order(build_task, seed, difficulty):
    env = build_task(BinFill, seed, difficulty)
    stream = Draws(seed)
    assert env.streaming == (stream.integer(0, 2) == 0) == (seed == STREAMING)
    read_button(stream, env.button, (-0.2, 0), (0.1, 0.4))
    x, y, yaw = (stream.uniform() for _ in range(3))
    rotation = np.deg2rad(-20 + 40 * yaw) / 2
    expected = [-0.05 + 0.2 * x, -0.2 + 0.4 * y, 0.025, np.cos(rotation), 0, 0, np.sin(rotation)]
    np.testing.assert_allclose([*env.board.pose.p, *env.board.pose.q], expected, atol=1e-6)
    pool = [COLOURS[i] for i in stream.permutation(3)][: AVAILABLE[difficulty]]
    colours, total = (stream.integer(low, high + 1) for low, high in (GOAL_COLOURS[difficulty], GOAL_CUBES[difficulty]))
    goal = Counter(pool[stream.integer(0, colours)] for _ in range(total)) if colours > 1 else Counter(pool[:1] * total)
    assert env.goal == goal and goal.total() == total
    low, high = CUBES[difficulty]
    cubes = stream.integer(low, high + 1)
    spawned = {colour: max(1, goal[colour]) for colour in pool}
    for _ in range(cubes - sum(spawned.values())):
        spawned[pool[stream.integer(0, len(pool)) if len(pool) > 1 else 0]] += 1
    assert {colour: len(env.cubes[colour]) for colour in pool} == spawned
    expected_colours, indices = [colour for colour in COLOURS for _ in range(spawned.get(colour, 0))], Counter()
    for i in stream.permutation(cubes):
        read_cube(stream, TABLE, env.cubes[expected_colours[i]][indices[expected_colours[i]]])
        indices[expected_colours[i]] += 1
    stream.permutation(3)  # an episode is initialised twice
    assert env.order == [("blue", "red", "green")[i] for i in stream.permutation(3)]
    assert len(env.all_cubes()) == cubes and least_distance(env.all_cubes()) >= 0.04


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


def test_a_recovery_episode_has_another_order_of_colours(build_task):
    env = build_task(BinFill, STATIC, "hard", recovery="z")
    stream = Draws(0)
    stream.restore(env._draws_state)
    picks = env.goal.total()
    stream.permutation(3)
    stream.integer(0, picks)
    assert env.order == [("blue", "red", "green")[i] for i in stream.permutation(3)]
    assert env.failed_pick == stream.integer(0, picks)
