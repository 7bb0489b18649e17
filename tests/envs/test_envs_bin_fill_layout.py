"""BinFill: the layout, when cubes appear, and what is drawn anew in every episode."""

from collections import Counter

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import numpy as np

from helpers.env_tasks import COLOURS, least_distance, make, read_button, read_cube, wait
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.bin_fill import BinFill

STREAMING, STATIC = 4, 1  # seeds
TABLE = Region((-0.1, 0), (0.2, 0.25))
AVAILABLE = {"easy": 1, "medium": 2, "hard": 3}
GOAL_COLOURS = {"easy": (1, 1), "medium": (1, 2), "hard": (2, 3)}
GOAL_CUBES = {"easy": (1, 3), "medium": (2, 4), "hard": (3, 5)}
CUBES = {"easy": (4, 6), "medium": (8, 10), "hard": (10, 12)}


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


def test_a_recovery_episode_has_another_order_of_colours():
    env = make(BinFill, STATIC, "hard", recovery="z")
    stream = Draws(0)
    stream.restore(env._draws_state)
    picks = env.goal.total()
    stream.permutation(3)
    stream.integer(0, picks)
    assert env.order == [("blue", "red", "green")[i] for i in stream.permutation(3)]
    assert env.failed_pick == stream.integer(0, picks)
    env.close()
