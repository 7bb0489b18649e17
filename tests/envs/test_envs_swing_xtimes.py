"""SwingXtimes: layout, how swings are counted and marked, and everything that fails."""

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import (
    COLOURS,
    Hand,
    least_distance,
    push_down,
    read_button,
    read_cube,
    read_disc,
    wait,
)
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.swing_xtimes import SwingXtimes

LOW = 0.11

SCENE = (SwingXtimes, 3601, "medium")


def swing_all(env: SwingXtimes, hand: Hand) -> None:
    hand.carry(env.cube)
    for _ in range(env.repetitions):
        for target in (env.right, env.left):
            assert hand.carry(env.cube, over=target, z=LOW) == (False, False)
            hand.carry(env.cube, over=env.button)


@pytest.mark.parametrize(
    ("seed", "difficulty", "cubes", "counts"),
    [(1, "easy", 1, {1, 2, 3}), (2, "easy", 1, {1, 2, 3}), (3, "medium", 3, {1, 2}), (7, "medium", 3, {1, 2}),
     (5, "hard", 3, {3}), (8, "hard", 3, {3})],
)  # fmt: skip
def test_everything_comes_from_the_stream_in_order(made, seed, difficulty, cubes, counts):
    env = made(SwingXtimes, seed, difficulty)
    assert env.repetitions == Draws(seed).integer(min(counts), max(counts) + 1) and env.repetitions in counts
    stream = Draws(seed)
    read_button(stream, env.button, (-0.2, 0), (0.1, 0.4))
    assert [cube.colour for cube in env.cubes] == [COLOURS[i] for i in stream.permutation(3)][:cubes]
    stream.integer(0, 3)
    for cube in env.cubes:
        read_cube(stream, Region((-0.1, 0), 0.25), cube)
    read_disc(stream, Region((-0.1, -0.2), 0.1), env.right)
    read_disc(stream, Region((-0.1, 0.2), 0.1), env.left)
    assert env.cube is env.cubes[stream.integer(0, cubes)]
    assert least_distance(env.cubes) >= 0.04 and env.right.position[1] < env.left.position[1]


def test_swings_then_down_then_the_button_are_success(env, hand):
    swing_all(env, hand)
    assert env.progress.current.text.startswith("put the")
    hand.release()
    assert env.progress.current.text == "press the button"
    assert push_down(env, env.button) == (True, False)
    assert wait(env) == (True, False)


def test_too_high_or_beside_the_target_is_no_swing(env, hand):
    hand.carry(env.cube)
    hand.carry(env.cube, over=env.right, z=0.15)
    assert env.progress.index == 1 and env.swings[0].count == 0
    hand.carry(env.cube, over=env.left, z=LOW)
    assert env.progress.index == 1 and env.swings[1].count == 1  # counted, but not the one that is due
    hand.carry(env.cube, over=env.right, z=LOW)
    assert env.progress.index == 2


def test_a_swing_ends_only_well_away_from_the_target(env, hand):
    hand.carry(env.cube)
    for z in (LOW, 0.2, LOW, 0.28, LOW):
        hand.carry(env.cube, over=env.right, z=z)
    assert env.swings[0].count == 1
    hand.carry(env.cube, over=env.right, z=0.35)
    hand.carry(env.cube, over=env.right, z=LOW)
    assert env.swings[0].count == 2


def test_one_swing_too_many_fails_and_stays_failed(env, hand):
    swing_all(env, hand)
    assert hand.carry(env.cube, over=env.right, z=LOW) == (False, True)
    assert hand.carry(env.cube, over=env.button) == (False, True)


@pytest.mark.parametrize("stage", ["pick", "swing", "put down"])
def test_the_button_before_its_time_fails(env, hand, stage):
    if stage == "swing":
        hand.carry(env.cube)
    elif stage == "put down":
        swing_all(env, hand)
    assert push_down(env, env.button) == (False, True)


@pytest.mark.parametrize("stage", ["pick", "press"])
def test_another_cube_in_the_hand_fails(env, hand, stage):
    if stage == "press":
        swing_all(env, hand)
        hand.release()
    other = next(cube for cube in env.cubes if cube is not env.cube)
    assert hand.carry(other) == (False, True)


def test_a_target_is_highlighted_while_the_cube_is_over_it_and_20_steps_longer(env, hand):
    right, left = env._marks
    hand.carry(env.cube, over=env.right, z=LOW)
    assert right.position == pytest.approx(env.right.position - [0, 0, 0.01]) and left.position[2] < -5
    hand.carry(env.cube, over=env.button)
    wait(env, 19)
    assert right.position == pytest.approx(env.right.position - [0, 0, 0.01])
    wait(env)
    assert right.position[2] < -5


@pytest.mark.parametrize(
    ("repetitions", "middle"),
    [(1, "put it down on the left-side target"),
     (2, "move it to the top of the left-side target, repeating this back-and-forth motion two times")],
)  # fmt: skip
def test_goals(env, monkeypatch, repetitions, middle):
    monkeypatch.setattr(env, "repetitions", repetitions)
    start = f"pick up the {env.cube.colour} cube, move it to the top of the right-side target, then"
    assert env.goals() == [f"{start} {middle}, finally press the button to stop"]
