"""PickXtimes, SwingXtimes and PickHighlight: what counts as done, what is highlighted, and what
fails.
"""

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import Hand, push_down, released, wait
from mme_vla.envs.robomme.tasks.pick_highlight import PickHighlight
from mme_vla.envs.robomme.tasks.pick_xtimes import PickXtimes
from mme_vla.envs.robomme.tasks.swing_xtimes import SwingXtimes

LOW = 0.11
SCENES = {
    "pick": (PickXtimes, 1600, "medium"),
    "swing": (SwingXtimes, 3601, "medium"),
}  # two and one repetitions
PICK, SWING = (
    pytest.mark.parametrize("env", [scene], indirect=True, ids=[name])
    for name, scene in SCENES.items()
)
HIGHLIGHT = pytest.mark.parametrize(
    "env", [(PickHighlight, 12600, "medium")], indirect=True, ids=["highlight"]
)


def swing_all(env: SwingXtimes, hand: Hand) -> None:
    hand.carry(env.cube)
    for _ in range(env.repetitions):
        for target in (env.right, env.left):
            assert hand.carry(env.cube, over=target, z=LOW) == (False, False)
            hand.carry(env.cube, over=env.button)


def do(env, hand: Hand, done: str) -> None:
    """Bring an episode to where this much is done."""
    if done == "picked":
        hand.carry(env.cube)
    elif done == "put down":
        hand.carry(env.cube)
        hand.release()
    elif "swung" in done:
        swing_all(env, hand)
        if done == "swung and put down":
            hand.release()


@pytest.mark.parametrize(
    ("env", "done"),
    [(SCENES["pick"], "nothing"), (SCENES["pick"], "put down"), (SCENES["swing"], "nothing"),
     (SCENES["swing"], "swung and put down")],
    indirect=["env"],
)  # fmt: skip
def test_another_cube_in_the_hand_fails_and_stays_failed(env, hand, done):
    do(env, hand, done)
    other = next(cube for cube in env.cubes if cube is not env.cube)
    assert hand.carry(other) == (False, True)
    hand.release()
    assert wait(env) == (False, True)


@pytest.mark.parametrize(
    ("env", "done"),
    [(SCENES["pick"], "nothing"), (SCENES["pick"], "picked"), (SCENES["swing"], "nothing"),
     (SCENES["swing"], "picked"), (SCENES["swing"], "swung")],
    indirect=["env"],
)  # fmt: skip
def test_the_button_before_its_time_fails_and_stays_failed(env, hand, done):
    do(env, hand, done)
    assert push_down(env, env.button) == (False, True)
    released(env, env.button)
    assert wait(env) == (False, True)


# PickXtimes ---------------------------------------------------------------------------------------


@PICK
def test_as_many_picks_and_places_as_requested_then_the_button_are_success(env, hand):
    assert env.repetitions == 2
    for i in range(2):
        assert hand.carry(env.cube) == (False, False) and env.progress.index == 2 * i + 1
        assert (
            hand.release(env.target.position) == (False, False) and env.progress.index == 2 * i + 2
        )
    assert push_down(env, env.button) == (True, False)
    assert wait(env) == (True, False)


@PICK
def test_grasped_low_is_not_picked_up(env, hand):
    hand.carry(env.cube, z=0.04)
    assert env.progress.index == 0


@PICK
def test_beside_the_target_or_still_grasped_is_not_placed(env, hand):
    hand.carry(env.cube)
    hand.carry(env.cube, over=env.target, z=0.03)
    assert env.progress.index == 1
    x, y, _ = env.target.position
    hand.release((x, y + 0.055))
    assert env.progress.index == 1
    hand.carry(env.cube)
    assert hand.release((x, y + 0.045)) == (False, False) and env.progress.index == 2


@PICK
def test_once_more_than_requested_fails(env, hand):
    for _ in range(2):
        hand.carry(env.cube)
        hand.release(env.target.position)
    assert hand.carry(env.cube) == (False, True)


# SwingXtimes --------------------------------------------------------------------------------------


@SWING
def test_swings_then_down_then_the_button_are_success(env, hand):
    swing_all(env, hand)
    assert env.progress.current.text.startswith("put the")
    hand.release()
    assert env.progress.current.text == "press the button"
    assert push_down(env, env.button) == (True, False)
    assert wait(env) == (True, False)


@SWING
def test_too_high_or_beside_the_target_is_no_swing(env, hand):
    hand.carry(env.cube)
    hand.carry(env.cube, over=env.right, z=0.15)
    assert env.progress.index == 1 and env.swings[0].count == 0
    hand.carry(env.cube, over=env.left, z=LOW)
    # counted, but not the one that is due
    assert env.progress.index == 1 and env.swings[1].count == 1
    hand.carry(env.cube, over=env.right, z=LOW)
    assert env.progress.index == 2


@SWING
def test_a_swing_ends_only_well_away_from_the_target(env, hand):
    hand.carry(env.cube)
    for z in (LOW, 0.2, LOW, 0.28, LOW):
        hand.carry(env.cube, over=env.right, z=z)
    assert env.swings[0].count == 1
    hand.carry(env.cube, over=env.right, z=0.35)
    hand.carry(env.cube, over=env.right, z=LOW)
    assert env.swings[0].count == 2


@SWING
def test_one_swing_too_many_fails_and_stays_failed(env, hand):
    swing_all(env, hand)
    assert hand.carry(env.cube, over=env.right, z=LOW) == (False, True)
    assert hand.carry(env.cube, over=env.button) == (False, True)


@SWING
def test_a_target_is_highlighted_while_the_cube_is_over_it_and_20_steps_longer(env, hand):
    right, left = env._marks
    hand.carry(env.cube, over=env.right, z=LOW)
    assert (
        right.position == pytest.approx(env.right.position - [0, 0, 0.01]) and left.position[2] < -5
    )
    hand.carry(env.cube, over=env.button)
    wait(env, 19)
    assert right.position == pytest.approx(env.right.position - [0, 0, 0.01])
    wait(env)
    assert right.position[2] < -5


# PickHighlight ------------------------------------------------------------------------------------


@HIGHLIGHT
def test_highlights_lie_under_the_goal_cubes_from_step_10_to_step_100(env):
    def is_highlighted() -> bool:
        discs = [disc.position for disc in env._discs]
        if all(place[2] < -5 for place in discs):
            return False
        for place, cube in zip(discs, env.goal_cubes, strict=True):
            assert place == pytest.approx(cube.position - [0, 0, 0.01], abs=1e-3)
        return True

    highlighted = []
    for _ in range(110):
        wait(env)
        highlighted.append(is_highlighted())
    assert highlighted == [10 <= k <= 100 for k in range(110)]  # k steps were done before


@HIGHLIGHT
def test_the_button_and_then_every_goal_cube_are_success(env, hand):
    first, second = env.goal_cubes
    assert push_down(env, env.button) == (False, False) and env.progress.index == 1
    released(env, env.button)
    assert hand.carry(first) == (False, False) and env.progress.index == 2
    assert hand.release() == (False, False) and env.progress.index == 3
    assert hand.carry(second) == (True, False)
    hand.release()
    assert wait(env) == (True, False)


@HIGHLIGHT
@pytest.mark.parametrize("pressed", [True, False])
def test_the_order_of_the_cubes_does_not_matter_nor_does_the_button(env, hand, pressed):
    if pressed:
        push_down(env, env.button)
    first, second = env.goal_cubes
    assert hand.carry(second) == (False, False)
    hand.release()
    assert hand.carry(second) == (False, False)  # once more is not another one
    hand.release()
    assert hand.carry(first) == (True, False)


@HIGHLIGHT
def test_a_cube_without_highlight_in_the_hand_fails_once_the_button_was_pressed(env, hand):
    other = next(cube for cube in env.cubes if cube not in env.goal_cubes)
    assert hand.carry(other) == (False, False)
    hand.release()
    push_down(env, env.button)
    assert wait(env) == (False, False)
    assert hand.carry(other) == (False, True)
    hand.release()
    assert wait(env) == (False, True)


@HIGHLIGHT
def test_another_cube_still_grasped_when_the_button_is_pressed_fails(env, hand):
    other = next(cube for cube in env.cubes if cube not in env.goal_cubes)
    hand.carry(other)
    assert push_down(env, env.button) == (False, False)
    assert hand.carry(other) == (False, True)
