"""MoveCube: layout of video and execution, the three manners, and what fails in each."""

import numpy as np
import pytest
import sapien

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import go_to, steps_of_demonstration, wait
from mme_vla.envs.robomme.scene.objects import H
from mme_vla.envs.robomme.scene.things import Thing
from mme_vla.envs.robomme.tasks.move_cube import MoveCube

HOOK, PUSH, GRASP = 5, 3, 0  # seeds
PICK_PEG, HOOK_CUBE = "Pick up the peg", "Hook the cube to the target with the peg"
PUSH_CUBE = "Close the gripper and push the cube to the target"
PICK_CUBE, PLACE_CUBE = "Pick up the cube", "place the cube onto the target"


def begin(env: MoveCube, monkeypatch: pytest.MonkeyPatch, text: str) -> list[Thing]:
    """Go to a sub-task of the execution with nothing in the hand; what is put into the list is
    held.
    """
    go_to(env, text)
    in_hand: list[Thing] = []
    monkeypatch.setattr(env, "is_grasping", lambda thing: thing in in_hand)
    return in_hand


def put(thing: Thing, place: np.ndarray, aside: float = 0.0, z: float = H) -> None:
    thing.move_to(sapien.Pose([place[0] + aside, place[1], z], thing.pose.q))


def lift(
    env: MoveCube, in_hand: list[Thing], thing: Thing, parts: list[Thing]
) -> tuple[bool, bool]:
    in_hand += parts
    put(thing, thing.position, z=0.2)
    return wait(env)


def yaw_of(thing: Thing) -> float:
    return 2 * np.arctan2(thing.pose.q[3], thing.pose.q[0])


@pytest.mark.parametrize("seed", [HOOK, PUSH, GRASP])
def test_on_the_way_back_from_the_video_everything_goes_to_its_place_in_the_execution(
    build_task, seed
):
    env = build_task(MoveCube, seed, "easy")
    layout = env.scene_values()["spec"]["layout"]["execution"]
    env.reset_in_progress = True
    wait(env)
    env.reset_in_progress = False
    assert env.target.position[:2] == pytest.approx(layout["goal_xy"], abs=1e-6)
    assert env.peg.position[:2] == pytest.approx(layout["peg_offsets"][1:], abs=1e-5)
    assert env.cube.position[:2] == pytest.approx(layout["cube_pose"][:2], abs=1e-6)
    for thing, yaw in ((env.peg, layout["peg_yaw"]), (env.cube, layout["cube_pose"][2])):
        assert np.cos(yaw - yaw_of(thing)) == pytest.approx(1, abs=1e-6)


def test_hooking_the_cube_onto_the_target_and_letting_go_is_success(build_task, monkeypatch):
    env = build_task(MoveCube, HOOK, "easy")
    in_hand = begin(env, monkeypatch, PICK_PEG)
    assert lift(env, in_hand, env.peg, [env.peg.tail]) == (False, False) and env.progress.index == 5
    put(env.cube, env.target.position, aside=0.055)
    assert wait(env) == (False, False)
    put(env.cube, env.target.position, aside=0.04)
    assert wait(env) == (True, False)


def test_pushing_counts_once_the_gripper_opens(build_task, monkeypatch):
    env = build_task(MoveCube, PUSH, "easy")
    begin(env, monkeypatch, PUSH_CUBE)
    closed = np.append(env.reset_action[:7], -1).astype(np.float32)
    for _ in range(5):
        env.step(closed)
    put(env.cube, env.target.position, aside=0.04)
    env.step(closed)
    assert not env.progress.succeeded
    assert wait(env, 5) == (True, False)


def test_grasping_and_placing_is_success(build_task, monkeypatch):
    env = build_task(MoveCube, GRASP, "easy")
    in_hand = begin(env, monkeypatch, PICK_CUBE)
    assert lift(env, in_hand, env.cube, [env.cube]) == (False, False) and env.progress.index == 5
    put(env.cube, env.target.position, aside=0.04)
    assert wait(env) == (False, False)  # still in the hand
    in_hand.clear()
    assert wait(env) == (True, False)


@pytest.mark.parametrize(
    ("seed", "text", "wrong"),
    [
        (HOOK, PICK_PEG, "cube"),
        (PUSH, PUSH_CUBE, "cube"),
        (PUSH, PUSH_CUBE, "peg"),
        (GRASP, PICK_CUBE, "peg"),
    ],
)
def test_another_thing_in_the_hand_fails(build_task, monkeypatch, seed, text, wrong):
    env = build_task(MoveCube, seed, "easy")
    in_hand = begin(env, monkeypatch, text)
    thing = getattr(env, wrong)
    assert lift(env, in_hand, thing, [thing] if wrong == "cube" else [env.peg.head]) == (
        False,
        True,
    )


@pytest.mark.parametrize(("seed", "text"), [(HOOK, PICK_PEG), (GRASP, PICK_CUBE)])
def test_the_cube_on_the_target_too_early_fails(build_task, monkeypatch, seed, text):
    env = build_task(MoveCube, seed, "easy")
    begin(env, monkeypatch, text)
    put(env.cube, env.target.position, aside=0.04)
    assert wait(env) == (False, True)


@pytest.mark.parametrize(
    ("seed", "text", "thing"), [(HOOK, HOOK_CUBE, "cube"), (GRASP, PLACE_CUBE, "peg")]
)
def test_in_the_last_stage_nothing_fails(build_task, monkeypatch, seed, text, thing):
    env = build_task(MoveCube, seed, "easy")
    in_hand = begin(env, monkeypatch, text)
    assert lift(env, in_hand, getattr(env, thing), [env.cube, env.peg.head]) == (False, False)


@pytest.mark.parametrize("seed", [HOOK, PUSH])
def test_hook_and_push_are_demonstrated(build_task, seed):
    assert steps_of_demonstration(build_task(MoveCube, seed, "easy")) is not None
