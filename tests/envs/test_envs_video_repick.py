"""VideoRepick: the swaps after the first pick, which picks count, and when the button may be
pressed.
"""

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import go_to, push_down, wait
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks.video_repick import VideoRepick

ONCE = 2  # a seed: one repetition and three swaps
FIRST, SECOND = (f"pick up the correct cube for the {i} time" for i in ("first", "second"))
VIDEO_SUBGOALS = ["pick up the cube", "drop the cube on the table"]
PUT, PRESS = "put it down", "press the button to finish"

SCENE = (VideoRepick, 1, "hard")  # two repetitions, no swaps


def pressed_after(env: VideoRepick, steps: int) -> bool:
    """Let time go by, hold the button down for one evaluation; whether that was a failure."""
    env._elapsed_steps += steps
    env.button.articulation.set_qpos(np.full((1, 1), -0.1, np.float32))
    failed = bool(env.evaluate()["fail"])
    env.button.restore()
    return failed


def test_the_video_ends_with_the_swaps_one_after_another(build_task):
    env = build_task(VideoRepick, ONCE, "medium")
    assert env.repetitions == 1 and env.swap_count == 3
    video = [*VIDEO_SUBGOALS, *["static"] * 4, "NO RECORD"]
    assert [step.text for step in env.progress.subtasks] == [*video, FIRST, PUT, PRESS]
    assert env.goals() == [
        (
            "watch the video carefully, then pick up the same block that was previously picked up"
            " again, finally put it down and press the button to stop"
        ),
        (
            "watch the video carefully, then pick up the same cube that was previously picked up"
            " again, finally press the button to stop"
        ),
    ]
    env.progress.index = 3
    wait(env)  # the swaps begin in the step after the one in which the stage was seen
    for initiator, _ in env.swapped:
        start = {cube: cube.position for cube in env.cubes}
        remaining = [cube for cube in env.cubes if cube is not initiator]
        partner, third = sorted(
            remaining, key=lambda cube: distance_xy(start[cube], start[initiator])
        )
        wait(env, 26)
        middle = (start[initiator] + start[partner]) / 2
        assert distance_xy(initiator.position, middle) == pytest.approx(0.07, abs=5e-3)
        wait(env, 24)
        for cube, place in ((initiator, partner), (partner, initiator), (third, third)):
            assert distance_xy(cube.position, start[place]) < 6e-3
    assert env.progress.index == 5  # the third of three stages of 50 steps
    assert wait(env, 5) == (False, False) and env.progress.index == 6


def test_as_many_picks_as_requested_and_the_button_are_success(env, hand):
    go_to(env, FIRST)
    for _ in range(2):
        assert hand.carry(env.cube) == (False, False)
        assert hand.release() == (False, False)
    assert env.progress.current.text == PRESS
    assert push_down(env, env.button) == (True, False)
    env.button.restore()
    assert wait(env) == (True, False)


@pytest.mark.parametrize("stage", [FIRST, PUT, SECOND])
def test_another_cube_picked_up_is_a_lasting_failure(env, hand, stage):
    go_to(env, stage)
    other = next(c for c in env.cubes if c is not env.cube and c.colour == env.cube.colour)
    assert hand.carry(other) == (False, True)
    assert hand.release() == (False, True)


@pytest.mark.parametrize("right", [True, False])
def test_any_cube_picked_up_instead_of_pressing_fails(env, hand, right):
    go_to(env, PRESS)
    assert hand.carry(env.cube if right else env.cubes[env.cubes.index(env.cube) - 1]) == (
        False,
        True,
    )
    assert push_down(env, env.button) == (False, True)


@pytest.mark.parametrize("stage", [FIRST, PUT])
@pytest.mark.parametrize(
    ("steps", "fails"), [(0, False), (49, False), (50, True), (500, True), (501, False)]
)
def test_pressing_too_early_fails_from_50_to_500_steps_after_the_stage_was_entered(
    env, hand, stage, steps, fails
):
    go_to(env, stage)
    if stage == PUT:
        hand.carry(env.cube)  # which enters the stage, too
    env.evaluate()
    assert pressed_after(env, steps) == fails
    assert wait(env) == (False, fails)


def test_picks_and_puts_have_a_timer_each_which_the_second_round_does_not_restart(env, hand):
    go_to(env, FIRST)
    env.evaluate()
    env._elapsed_steps += 100
    hand.carry(env.cube)  # the pick is done
    assert not pressed_after(env, 0)  # the wait of the put begins here
    hand.release()
    assert env.progress.current.text == SECOND
    assert not pressed_after(env, 460)  # 560 steps after the first pick began
    assert hand.carry(env.cube) == (False, False)
    assert pressed_after(env, 0)  # some 460 steps after the first put began
