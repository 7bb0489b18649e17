"""SwingXtimes: layout, how swings are counted and marked, and everything that fails."""

from collections.abc import Iterator

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_cubes import COLOURS, Hand, least_distance, read_button, read_cube, read_disc
from helpers.env_unmask import make, push_down, texts, wait
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.tasks.swing_xtimes import SwingXtimes

LOW = 0.11


@pytest.fixture(scope="module")
def swing() -> Iterator[SwingXtimes]:
    env = make(SwingXtimes, 3601, "medium")
    yield env
    env.close()


@pytest.fixture
def hand(swing: SwingXtimes, monkeypatch: pytest.MonkeyPatch) -> Hand:
    swing.reset()
    return Hand(swing, monkeypatch)


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
def test_everything_comes_from_the_stream_in_order(seed, difficulty, cubes, counts):
    env = make(SwingXtimes, seed, difficulty)
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
    env.close()


def test_swings_then_down_then_the_button_are_success(swing, hand):
    swing_all(swing, hand)
    assert swing.progress.current.text.startswith("put the")
    hand.release()
    assert swing.progress.current.text == "press the button"
    assert push_down(swing, swing.button) == (True, False)
    assert wait(swing) == (True, False)


def test_too_high_or_beside_the_target_is_no_swing(swing, hand):
    hand.carry(swing.cube)
    hand.carry(swing.cube, over=swing.right, z=0.15)
    assert swing.progress.index == 1 and swing.swings[0].count == 0
    hand.carry(swing.cube, over=swing.left, z=LOW)
    assert swing.progress.index == 1 and swing.swings[1].count == 1  # counted, but not the one that is due
    hand.carry(swing.cube, over=swing.right, z=LOW)
    assert swing.progress.index == 2


def test_a_swing_ends_only_well_away_from_the_target(swing, hand):
    hand.carry(swing.cube)
    for z in (LOW, 0.2, LOW, 0.28, LOW):
        hand.carry(swing.cube, over=swing.right, z=z)
    assert swing.swings[0].count == 1
    hand.carry(swing.cube, over=swing.right, z=0.35)
    hand.carry(swing.cube, over=swing.right, z=LOW)
    assert swing.swings[0].count == 2


def test_one_swing_too_many_fails_and_stays_failed(swing, hand):
    swing_all(swing, hand)
    assert hand.carry(swing.cube, over=swing.right, z=LOW) == (False, True)
    assert hand.carry(swing.cube, over=swing.button) == (False, True)


@pytest.mark.parametrize("stage", ["pick", "swing", "put down"])
def test_the_button_before_its_time_fails(swing, hand, stage):
    if stage == "swing":
        hand.carry(swing.cube)
    elif stage == "put down":
        swing_all(swing, hand)
    assert push_down(swing, swing.button) == (False, True)


@pytest.mark.parametrize("stage", ["pick", "press"])
def test_another_cube_in_the_hand_fails(swing, hand, stage):
    if stage == "press":
        swing_all(swing, hand)
        hand.release()
    other = next(cube for cube in swing.cubes if cube is not swing.cube)
    assert hand.carry(other) == (False, True)


def test_a_target_is_highlighted_while_the_cube_is_over_it_and_20_steps_longer(swing, hand):
    right, left = swing._marks
    hand.carry(swing.cube, over=swing.right, z=LOW)
    assert right.position == pytest.approx(swing.right.position - [0, 0, 0.01]) and left.position[2] < -5
    hand.carry(swing.cube, over=swing.button)
    wait(swing, 19)
    assert right.position == pytest.approx(swing.right.position - [0, 0, 0.01])
    wait(swing)
    assert right.position[2] < -5


def test_texts(swing):
    colour, text = swing.cube.colour, texts(swing)
    assert text[:3] + text[-2:] == [
        (f"pick up the {colour} cube", f"pick up the {colour} cube at <>", "a"),
        *((f"move to the top of the {side}-side target for the first time",
           f"move to the top of the {side}-side target at <> for the first time", "b") for side in ("right", "left")),
        (f"put the {colour} cube on the table", f"put the {colour} cube on the table", "c"),
        ("press the button", "press the button at <>", "d"),
    ]  # fmt: skip
    assert len(text) == 3 + 2 * swing.repetitions
    assert [option.needs_point for option in swing.choices()] == [True, True, False, False]


@pytest.mark.parametrize(
    ("repetitions", "middle"),
    [(1, "put it down on the left-side target"),
     (2, "move it to the top of the left-side target, repeating this back-and-forth motion two times")],
)  # fmt: skip
def test_goals(swing, monkeypatch, repetitions, middle):
    monkeypatch.setattr(swing, "repetitions", repetitions)
    start = f"pick up the {swing.cube.colour} cube, move it to the top of the right-side target, then"
    assert swing.goals() == [f"{start} {middle}, finally press the button to stop"]
