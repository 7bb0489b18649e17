"""VideoPlaceButton and VideoPlaceOrder: the last swap, success and failure."""

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import go_to, steps_of_demonstration, wait
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks.families.video_place import VideoPlace
from mme_vla.envs.robomme.tasks.video_place_button import VideoPlaceButton
from mme_vla.envs.robomme.tasks.video_place_order import VideoPlaceOrder

NEAR, FAR = np.array([0.049, 0, 0]), np.array([0.051, 0, 0])
PICK, PLACE = "pick up the cube", "place the cube onto the correct target"


@pytest.fixture(params=[(VideoPlaceOrder, 1), (VideoPlaceButton, 2)], ids=["order", "button"])
def env(request: pytest.FixtureRequest, build_task) -> VideoPlace:
    """Either task; the rules of the execution are the same."""
    return build_task(*request.param, "hard")


def test_two_targets_change_places_at_the_end_of_a_hard_video(env):
    env.progress.index = len(env.progress.subtasks) - 4
    start = {target: target.position for target in env.targets}
    wait(env)  # the swap begins in the step after the one in which the stage was seen
    a, b = env._swapped
    wait(env, 26)
    aside = [distance_xy(target.position, (start[a] + start[b]) / 2) for target in (a, b)]
    assert aside == pytest.approx([0.1, 0.1], abs=1e-3)
    wait(env, 25)
    for target in env.targets:
        assert target.position == pytest.approx(start[{a: b, b: a}.get(target, target)], abs=1e-5)
    assert wait(env, 10) == (False, False) and env.progress.displayed.text == "NO RECORD"


def test_the_cube_on_the_right_target_is_success(env, hand):
    go_to(env, PICK)
    assert hand.carry(env.cube) == (False, False) and env.progress.current.text == PLACE
    assert hand.carry(env.cube, over=env.goal_target) == (False, False)
    assert hand.release() == (False, False)  # beside every target
    hand.carry(env.cube)
    assert hand.release(env.goal_target.position + NEAR) == (True, False)


def test_the_cube_on_another_target_fails(env, hand):
    go_to(env, PLACE)
    other = next(target for target in env.targets if target is not env.goal_target)
    assert hand.carry(env.cube, over=other, z=0.03) == (False, False)  # not let go
    assert hand.release(other.position + FAR) == (False, False)
    hand.carry(env.cube)
    assert hand.release(other.position + NEAR) == (False, True)
    hand.carry(env.cube)
    assert hand.release(env.goal_target.position) == (True, False)  # judged anew at each step


def test_another_cube_picked_up_fails_instead_of_the_cube_only(env, hand):
    other = next(cube for cube in env.cubes if cube is not env.cube)
    go_to(env, PICK)
    assert hand.carry(other) == (False, True)
    assert hand.release() == (False, False)
    go_to(env, PLACE)
    assert hand.carry(other) == (False, False)


def test_a_demonstration_ends_in_success(build_task):
    env = build_task(VideoPlaceButton, 10000, "easy")
    assert steps_of_demonstration(env) is not None
    assert distance_xy(env.cube.position, env.goal_target.position) < 0.05
