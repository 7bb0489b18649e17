"""PickXtimes: layout, what counts as picked and placed, and everything that fails."""

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import COLOURS, least_distance, push_down, read_button, read_cube, read_disc, released, wait
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.scene.things import distance_xy
from mme_vla.envs.tasks.pick_xtimes import PickXtimes

TABLE = Region((-0.1, 0.0), 0.2)

SCENE = (PickXtimes, 1600, "medium")  # two repetitions, three cubes


@pytest.mark.parametrize(
    ("seed", "difficulty", "cubes", "counts"),
    [(1, "easy", 1, {1, 2, 3}), (2, "easy", 1, {1, 2, 3}), (3, "medium", 3, {1, 2, 3}), (4, "medium", 3, {1, 2, 3}),
     (5, "hard", 3, {4, 5}), (6, "hard", 3, {4, 5})],
)  # fmt: skip
def test_everything_comes_from_the_stream_in_order(made, seed, difficulty, cubes, counts):
    env = made(PickXtimes, seed, difficulty)
    assert env.repetitions == Draws(seed).integer(min(counts), max(counts) + 1) and env.repetitions in counts
    stream = Draws(seed)
    read_button(stream, env.button, (-0.2, 0), (0.1, 0.4))
    colours = [COLOURS[i] for i in stream.permutation(3)]
    assert [cube.colour for cube in env.cubes] == colours[:cubes]
    stream.integer(0, 3)
    for cube in env.cubes:
        read_cube(stream, TABLE, cube)
    read_disc(stream, TABLE, env.target)
    assert env.cube is env.cubes[stream.integer(0, cubes)]
    assert least_distance(env.cubes) >= 0.04
    assert min(distance_xy(cube.initial_pose.p, env.target.position) for cube in env.cubes) >= 0.08


def test_as_many_picks_and_places_as_requested_then_the_button_are_success(env, hand):
    assert env.repetitions == 2
    for i in range(2):
        assert hand.carry(env.cube) == (False, False) and env.progress.index == 2 * i + 1
        assert hand.release(env.target.position) == (False, False) and env.progress.index == 2 * i + 2
    assert push_down(env, env.button) == (True, False)
    assert wait(env) == (True, False)


def test_grasped_low_is_not_picked_up(env, hand):
    hand.carry(env.cube, z=0.04)
    assert env.progress.index == 0


def test_beside_the_target_or_still_grasped_is_not_placed(env, hand):
    hand.carry(env.cube)
    hand.carry(env.cube, over=env.target, z=0.03)
    assert env.progress.index == 1
    x, y, _ = env.target.position
    hand.release((x, y + 0.055))
    assert env.progress.index == 1
    hand.carry(env.cube)
    assert hand.release((x, y + 0.045)) == (False, False) and env.progress.index == 2


@pytest.mark.parametrize("stage", [0, 1])
def test_another_cube_in_the_hand_fails_and_stays_failed(env, hand, stage):
    if stage:
        hand.carry(env.cube)
        hand.release()
    other = next(cube for cube in env.cubes if cube is not env.cube)
    assert hand.carry(other) == (False, True)
    hand.release()
    assert wait(env) == (False, True)


@pytest.mark.parametrize("stage", [0, 1])
def test_the_button_before_its_time_fails(env, hand, stage):
    if stage:
        hand.carry(env.cube)
    assert push_down(env, env.button) == (False, True)
    released(env, env.button)
    assert wait(env) == (False, True)


def test_once_more_than_requested_fails(env, hand):
    for _ in range(2):
        hand.carry(env.cube)
        hand.release(env.target.position)
    assert hand.carry(env.cube) == (False, True)
