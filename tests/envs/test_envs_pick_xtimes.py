"""PickXtimes: layout, what counts as picked and placed, and everything that fails."""

from collections.abc import Iterator

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_cubes import COLOURS, Hand, least_distance, read_button, read_cube, read_disc
from helpers.env_unmask import make, push_down, released, texts, wait
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.scene.things import distance_xy
from mme_vla.envs.tasks.pick_xtimes import PickXtimes

TABLE = Region((-0.1, 0.0), 0.2)


@pytest.fixture(scope="module")
def twice() -> Iterator[PickXtimes]:
    env = make(PickXtimes, 1600, "medium")  # two repetitions, three cubes
    yield env
    env.close()


@pytest.fixture
def hand(twice: PickXtimes, monkeypatch: pytest.MonkeyPatch) -> Hand:
    twice.reset()
    return Hand(twice, monkeypatch)


@pytest.mark.parametrize(
    ("seed", "difficulty", "cubes", "counts"),
    [(1, "easy", 1, {1, 2, 3}), (2, "easy", 1, {1, 2, 3}), (3, "medium", 3, {1, 2, 3}), (4, "medium", 3, {1, 2, 3}),
     (5, "hard", 3, {4, 5}), (6, "hard", 3, {4, 5})],
)  # fmt: skip
def test_everything_comes_from_the_stream_in_order(seed, difficulty, cubes, counts):
    env = make(PickXtimes, seed, difficulty)
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
    env.close()


def test_as_many_picks_and_places_as_requested_then_the_button_are_success(twice, hand):
    assert twice.repetitions == 2
    for i in range(2):
        assert hand.carry(twice.cube) == (False, False) and twice.progress.index == 2 * i + 1
        assert hand.release(twice.target.position) == (False, False) and twice.progress.index == 2 * i + 2
    assert push_down(twice, twice.button) == (True, False)
    assert wait(twice) == (True, False)


def test_grasped_low_is_not_picked_up(twice, hand):
    hand.carry(twice.cube, z=0.04)
    assert twice.progress.index == 0


def test_beside_the_target_or_still_grasped_is_not_placed(twice, hand):
    hand.carry(twice.cube)
    hand.carry(twice.cube, over=twice.target, z=0.03)
    assert twice.progress.index == 1
    x, y, _ = twice.target.position
    hand.release((x, y + 0.055))
    assert twice.progress.index == 1
    hand.carry(twice.cube)
    assert hand.release((x, y + 0.045)) == (False, False) and twice.progress.index == 2


@pytest.mark.parametrize("stage", [0, 1])
def test_another_cube_in_the_hand_fails_and_stays_failed(twice, hand, stage):
    if stage:
        hand.carry(twice.cube)
        hand.release()
    other = next(cube for cube in twice.cubes if cube is not twice.cube)
    assert hand.carry(other) == (False, True)
    hand.release()
    assert wait(twice) == (False, True)


@pytest.mark.parametrize("stage", [0, 1])
def test_the_button_before_its_time_fails(twice, hand, stage):
    if stage:
        hand.carry(twice.cube)
    assert push_down(twice, twice.button) == (False, True)
    released(twice, twice.button)
    assert wait(twice) == (False, True)


def test_once_more_than_requested_fails(twice, hand):
    for _ in range(2):
        hand.carry(twice.cube)
        hand.release(twice.target.position)
    assert hand.carry(twice.cube) == (False, True)


def test_texts_and_goals(twice):
    colour = twice.cube.colour
    assert texts(twice)[:2] + texts(twice)[-1:] == [
        (f"pick up the {colour} cube for the first time", f"pick up the {colour} cube at <> for the first time", "a"),
        (f"place the {colour} cube onto the target", f"place the {colour} cube onto the target at <>", "b"),
        ("press the button to stop", "press the button at <> to stop", "c"),
    ]
    assert twice.goals() == [
        f"pick up the {colour} cube and place it on the target, repeating this {action} two times, "
        "then press the button to stop"
        for action in ("action", "pick-and-place action")
    ]
    assert [option.needs_point for option in twice.choices()] == [True, False, False]


def test_a_single_time_is_not_called_a_repetition():
    env = make(PickXtimes, next(s for s in range(99) if Draws(s).integer(1, 4) == 1), "easy")
    assert env.goals() == [
        f"pick up the {env.cube.colour} cube and place it on the target, then press the button to stop"
    ]
    env.close()
