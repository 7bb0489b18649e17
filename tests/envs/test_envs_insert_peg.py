"""InsertPeg: near and far ends, what counts as grasped and inserted, and everything that fails."""

from contextlib import suppress

import numpy as np
import pytest
import sapien

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import steps_of_demonstration, wait
from mme_vla.envs.robomme.robot.control import PlanningError
from mme_vla.envs.robomme.scene.articulated import Peg
from mme_vla.envs.robomme.scene.objects import at
from mme_vla.envs.robomme.tasks.insert_peg import InsertPeg

GRASPING, INSERTING = 4, 5
"""Indices of the execution's sub-tasks."""
VIDEO_GRASPING, VIDEO_INSERTING = 0, 1
OTHER = {"head": "tail", "tail": "head"}


@pytest.fixture(
    params=[("head", 1), ("head", -1), ("tail", 1), ("tail", -1)], ids=lambda p: f"{p[0]}{p[1]:+}"
)
def env(build_task, request, monkeypatch) -> InsertPeg:
    """At the grasp of the execution; whatever is in the air is in the hand."""
    env = build_task(InsertPeg, 13602, "medium")
    env.end, env.side = request.param
    env.progress.subtasks[:] = env.subtasks()
    env.progress.index = GRASPING
    monkeypatch.setattr(env, "is_grasping", lambda thing: True)
    return env


def raise_peg(env: InsertPeg, peg: Peg, end: str) -> tuple[bool, bool]:
    """Put a peg in the air below the tool, one end nearer to it than the other, and do a step."""
    x = env.tcp_pose.p[0] + (0.0 if end == "head" else peg.length)
    peg.move_to(at((x, 0.0), 0.2, 0.0))
    return wait(env)


def insert(env: InsertPeg, grasped: str, side: int, short: float = 0.0) -> tuple[bool, bool]:
    """Put the end that is not grasped into the box, the tool on the given side of the box, and do a
    step.
    """
    env.box.move_to(at((0.0, 0.1 * side), env.box.position[2], np.pi / 2))
    along = -short if grasped == "tail" else env.peg.length + short
    env.peg.move_to(env.box.pose * sapien.Pose([along, 0, 0]))
    return wait(env)


def test_texts_name_the_end_from_the_robot_and_the_side(env):
    grasped, free = env.ends(env.end)
    word = "near" if grasped.position[0] < free.position[0] else "far"
    grasp = f"Pick up the peg by grasping the {word} end"
    side, letter = ("right", "b") if env.side == 1 else ("left", "c")
    insertion = f"Insert the peg from the {side} side"
    texts = [(step.text, step.choice) for step in env.progress.subtasks]
    assert texts[:2] == [(grasp, "a"), (f"{insertion} of the box", letter)]
    assert texts[-2:] == [(grasp, "a"), (insertion, letter)]


def test_the_right_end_up_and_the_other_in_from_the_right_side_is_success(env):
    assert raise_peg(env, env.peg, env.end) == (False, False) and env.progress.index == INSERTING
    assert insert(env, env.end, env.side, short=0.06) == (False, False)
    assert insert(env, env.end, env.side) == (True, False)


def test_an_insertion_is_displayed_in_red_for_twenty_steps_after_it(env):
    hidden = env._red_disc.position[2]
    env.progress.index = INSERTING
    insert(env, env.end, env.side)
    assert env._red_disc.position[2] > 0
    env.peg.restore()
    wait(env, 20)
    assert env._red_disc.position[2] > 0
    wait(env)
    assert env._red_disc.position[2] == hidden < 0


def test_the_wrong_end_up_fails_but_not_in_the_video(env):
    env.progress.index = VIDEO_GRASPING
    assert (
        raise_peg(env, env.peg, OTHER[env.end]) == (False, False)
        and env.progress.index == VIDEO_GRASPING
    )
    env.progress.index = GRASPING
    assert raise_peg(env, env.peg, OTHER[env.end]) == (False, True)


@pytest.mark.parametrize("stage", [GRASPING, INSERTING])
def test_another_peg_in_the_hand_fails(env, stage):
    env.progress.index = stage
    assert raise_peg(env, env.pegs[2], env.end) == (False, True)


def test_the_wrong_end_in_the_box_fails(env):
    env.progress.index = INSERTING
    assert insert(env, OTHER[env.end], env.side) == (False, True)


def test_from_the_other_side_fails_but_not_in_the_video(env):
    env.progress.index = VIDEO_INSERTING
    assert (
        insert(env, env.end, -env.side) == (False, False) and env.progress.index == VIDEO_INSERTING
    )
    env.progress.index = INSERTING
    assert insert(env, env.end, -env.side) == (False, True)


def test_on_the_way_back_from_the_video_the_pegs_are_where_they_were(env):
    raise_peg(env, env.peg, env.end)
    env.reset_in_progress = True
    wait(env)
    for peg in env.pegs:
        np.testing.assert_allclose(peg.pose.p, peg.initial_pose.p, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "seed", [710002, 9000063, 9000014], ids=["beside the box", "flung off", "out of reach"]
)
def test_where_the_official_demonstrator_fails_the_local_one_retries(build_task, seed: int):
    env = build_task(InsertPeg, seed, "easy")
    assert steps_of_demonstration(env) is not None
    env.second_tries = False
    env.reset()
    with suppress(PlanningError):
        assert steps_of_demonstration(env) is None
