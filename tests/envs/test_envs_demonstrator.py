"""The demonstrator: what each primitive does to a scene, and whole demonstrations against the
recorded ones.
"""

from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulator is not installed")

import sapien
from scipy.spatial.transform import Rotation

from helpers.env_scenes import Scene
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator, PlanningError, arc
from mme_vla.envs.robomme.robot.gripper_skills import failing_offset, grasp_orientation
from mme_vla.envs.robomme.scene.articulated import PEG_COLOUR, build_button, build_peg
from mme_vla.envs.robomme.scene.objects import (
    build_aperture_box,
    build_board,
    build_container,
    build_cube,
    build_disc,
)
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.task import Task


class Log:
    """A demonstrator that notes its steps and its waypoints."""

    def __init__(self, env: Task) -> None:
        self.env = env
        self.actions: list[np.ndarray] = []
        self.waypoints: list[np.ndarray] = []
        self.demonstrator = Demonstrator(env, self._step, self._note)

    def _step(self, action: np.ndarray) -> None:
        self.env.step(action)
        self.actions.append(action)

    def _note(self, pose: sapien.Pose, gripper: float) -> None:
        angles = Rotation.from_quat(np.roll(pose.q, -1)).as_euler("xyz")
        self.waypoints.append(np.concatenate([pose.p, angles, [gripper]]))

    @property
    def grips(self) -> list[float]:
        return [waypoint[6] for waypoint in self.waypoints]


def scene(fill: Callable[[Scene], None], stick: bool = False) -> tuple[Scene, Log, Demonstrator]:
    env = Scene(fill, stick=stick)
    env.reset()
    log = Log(env)
    return env, log, log.demonstrator


def things(env: Scene) -> dict:
    return {thing.name: thing for thing in env.things}


def pick_and_place(env: Scene) -> None:
    env.add(build_cube(env, "cube", "red", (-0.1, 0.1), 0.3))
    env.add(build_disc(env, "target", 0.04, 0.005, "purple", (0.0, -0.1)))


def test_a_cube_is_picked_up_and_placed() -> None:
    env, log, demonstrator = scene(pick_and_place)
    cube, target = (things(env)[name] for name in ("cube", "target"))
    demonstrator.pick(cube)
    assert env.is_grasping(cube) and cube.position[2] > 0.1
    assert log.grips == [1, -1, -1]
    demonstrator.place_on(target)
    assert not env.is_grasping(cube) and distance_xy(cube.position, target.position) < 0.02
    assert log.grips[3:] == [-1, 1, 1]
    demonstrator.pick(cube)
    demonstrator.move_over(target, 0.1)
    assert env.tcp_pose.p[2] == pytest.approx(0.1, abs=0.01) and log.grips[-1] == -1
    demonstrator.put_down(0.03)
    assert cube.position[2] < 0.03 and not env.is_grasping(cube)
    demonstrator.go_home()
    np.testing.assert_allclose(env.tcp_pose.p, [0, 0, 0.2], atol=0.01)


def test_waypoints_are_announced_before_the_motion() -> None:
    env, log, demonstrator = scene(pick_and_place)
    before = len(log.actions)
    pose = demonstrator.at([-0.1, 0.0, 0.3])
    announced: list[int] = []
    demonstrator._on_waypoint = lambda *_: announced.append(len(log.actions))
    demonstrator.move_to(pose, 1.0)
    demonstrator.move_to(pose)
    assert announced == [before]
    env.close()


@pytest.mark.parametrize(("mode", "height"), [("z", 0.06), ("xy", 0.02)])
def test_a_pick_set_to_fail_fails_once(mode: str, height: float) -> None:
    env, log, demonstrator = scene(pick_and_place)
    cube = things(env)["cube"]
    demonstrator.fail_next_pick = mode
    start = cube.position
    demonstrator.pick(cube)
    assert log.grips == [1, -1, 1, 1, -1, -1]
    wrong = log.waypoints[1][:3]
    np.testing.assert_allclose(wrong - start, failing_offset(mode, 0.04, env.seed), atol=1e-4)
    assert wrong[2] == pytest.approx(height, abs=1e-4)
    assert env.is_grasping(cube) and demonstrator.fail_next_pick is None


def test_failing_offsets_point_somewhere() -> None:
    offsets = np.array([failing_offset("xy", 0.04, seed) for seed in range(40)])
    assert set(np.unique(np.round(offsets[:, :2] / 0.04))) == {-1, 0, 1}
    assert (np.abs(offsets).sum(1) > 0).all() and (offsets[:, 2] == 0).all()
    # as VideoUnmask's fourth episode
    np.testing.assert_allclose(failing_offset("xy", 0.035, 6400), [-0.035, 0, 0])


def test_the_hand_takes_the_nearer_of_two_equal_sides() -> None:
    env, _, _ = scene(pick_and_place)
    cube = things(env)["cube"]
    for closing in ([0, -1, 0], [1, 0, 0], [0, 1, 0]):
        q = grasp_orientation(cube, np.array(closing, float))
        matrix = Rotation.from_quat(np.roll(q, -1)).as_matrix()
        np.testing.assert_allclose(matrix[:, 2], [0, 0, -1], atol=1e-6)
        assert matrix[:, 1] @ closing == pytest.approx(np.cos(0.3), abs=1e-4)


def test_a_container_is_lifted_by_its_handle() -> None:
    env, _, demonstrator = scene(
        lambda env: env.add(build_container(env, "container", (0.1, -0.1), 0.5))
    )
    container = things(env)["container"]
    demonstrator.pick_container(container)
    assert container.position[2] > 0.15
    demonstrator.put_down()
    assert container.position[2] < 0.07 and env.tcp_pose.p[2] > 0.1


def test_a_button_is_pressed_and_released() -> None:
    env, log, demonstrator = scene(lambda env: env.add(build_button(env, (-0.2, 0.1))))
    button = things(env)["button"]
    demonstrator.hover(button)
    hovering, deepest = len(log.actions), 0.0

    def step(action: np.ndarray) -> None:
        nonlocal deepest
        log._step(action)
        deepest = max(deepest, button.depth)

    demonstrator.step = step
    demonstrator.press(button, hold=False)
    assert deepest > 0.005 > button.depth
    assert log.grips == [-1, -1, -1, -1]
    assert np.allclose(np.array(log.actions)[hovering:, 7], -1)


def test_what_is_grasped_falls_into_the_bin() -> None:
    def fill(env: Scene) -> None:
        env.add(build_cube(env, "cube", "red", (-0.2, 0.1)))
        env.add(build_board(env, (0.05, 0.0), 0.2))

    env, _, demonstrator = scene(fill)
    cube, board = things(env)["cube"], things(env)["board"]
    demonstrator.pick(cube)
    demonstrator.drop_into_bin(board)
    assert distance_xy(cube.position, board.position) < 0.03 and cube.position[2] < 0.03
    assert env.tcp_pose.p[0] == pytest.approx(-0.05, abs=0.01)


def test_waiting_takes_full_gripper_motions() -> None:
    env, log, demonstrator = scene(lambda _: None)
    demonstrator.hold(20)
    assert len(log.actions) == 24 and all(action[7] == 1 for action in log.actions)
    demonstrator.hold_until(30)
    assert env.steps_done == 30 and log.actions[-1][7] == -1
    demonstrator.hold_until(30)
    assert env.steps_done == 30


def test_a_hard_reset_returns_the_arm() -> None:
    env, log, demonstrator = scene(lambda _: None)
    demonstrator.move_to(demonstrator.at([-0.2, 0.2, 0.2]))
    before = len(log.actions)
    flags = []
    demonstrator.step = lambda action: (
        log._step(action),
        flags.append((env.reset_in_progress, env.after_video)),
    )
    demonstrator.hard_reset()
    assert len(log.actions) - before == 36
    # Objects are restored after every step of the way back but the first.
    assert (
        flags == [(False, False)] * 7 + [(True, False)] * 29
        and env.after_video
        and not env.reset_in_progress
    )
    assert np.abs(env.qpos[:7] - env.reset_action[:7]).max() < 0.01


@pytest.mark.parametrize(
    ("cube", "goal"), [((-0.1, 0.05), (0.02, 0.12)), ((0.05, 0.0), (-0.1, 0.02))]
)
def test_a_cube_is_pushed_to_a_goal(cube: tuple[float, float], goal: tuple[float, float]) -> None:
    def fill(env: Scene) -> None:
        env.add(build_cube(env, "cube", "red", cube))
        env.add(build_disc(env, "goal", 0.04, 0.005, "purple", goal))

    env, log, demonstrator = scene(fill)
    demonstrator.push(things(env)["cube"], things(env)["goal"])
    assert distance_xy(things(env)["cube"].position, np.array(goal)) < 0.048
    assert (env.fingers > 0.03).all() and log.grips == [-1, -1, 1]
    # Never turned so far that the camera looks back at the robot.
    assert abs(log.waypoints[0][5]) <= np.pi / 2


@pytest.mark.parametrize(
    ("cube", "goal"), [((0.0, 0.1), (-0.05, -0.03)), ((-0.02, -0.1), (-0.05, 0.04))]
)
def test_a_cube_is_hooked_to_a_goal_with_a_peg(
    cube: tuple[float, float], goal: tuple[float, float]
) -> None:
    def fill(env: Scene) -> None:
        env.add(build_cube(env, "cube", "red", cube))
        env.add(build_disc(env, "goal", 0.04, 0.005, "purple", goal))
        env.add(build_peg(env, "peg", 0.1, 0.01, PEG_COLOUR, PEG_COLOUR, (-0.1, -0.25), 0.2))

    env, log, demonstrator = scene(fill)
    peg = things(env)["peg"]
    demonstrator.grasp_peg(peg, "tail")
    assert env.is_grasping(peg.tail) and peg.tail.position[2] > 0.1
    demonstrator.hook(things(env)["cube"], things(env)["goal"])
    assert distance_xy(things(env)["cube"].position, np.array(goal)) < 0.048
    assert log.grips == [1, -1, -1, -1, -1, 1]


@pytest.mark.parametrize(
    ("grasped", "side", "motion"),
    [
        ("tail", 1, "insert_peg"),
        ("head", 1, "insert_peg"),
        ("head", -1, "insert_peg"),
        ("head", 1, "insert_peg_fully"),
    ],
)
def test_a_peg_is_inserted_from_the_side_that_was_requested(
    grasped: str, side: int, motion: str
) -> None:
    def fill(env: Scene) -> None:
        env.add(build_aperture_box(env, (0.0, 0.0), np.pi / 2))
        env.add(
            build_peg(
                env, "peg", 0.05, 0.01, (1, 0, 0), (0, 1, 0), (-0.15, -0.15 * side), 0.4 * side
            )
        )

    env, _, demonstrator = scene(fill)
    peg, box = things(env)["peg"], things(env)["box"]
    demonstrator.grasp_peg(peg, grasped)
    getattr(demonstrator, motion)(peg, grasped, side, box)
    free = peg.head if grasped == "tail" else peg.tail
    assert (env.tcp_pose.p[1] - box.position[1]) * side < 0
    # As in the benchmark, this one motion ends with the peg's end only just in the box.
    short = (grasped, side, motion) == ("tail", 1, "insert_peg")
    assert np.linalg.norm(free.position - box.position) < (0.08 if short else 0.05)
    demonstrator.insert_peg_fully(peg, grasped, side, box, begun=True)
    assert np.linalg.norm(free.position - box.position) < 0.05


@pytest.mark.slow
def test_out_of_reach_is_reported_before_anything_moves() -> None:
    _, log, demonstrator = scene(lambda _: None)
    with pytest.raises(PlanningError, match=r"No way to \[0\.9"):
        demonstrator.move_to(demonstrator.at([0.9, 0.0, 0.3]))
    assert log.actions == []


def test_the_stick_goes_straight_and_remembers_where_it_arrived() -> None:
    env, log, demonstrator = scene(
        lambda env: env.add(build_disc(env, "disc", 0.02, 0.01, "gray", (-0.1, 0.1))), stick=True
    )
    demonstrator.open()
    assert log.actions == []
    demonstrator.stick_to(things(env)["disc"], store=True)
    assert distance_xy(env.tcp_pose.p, np.array([-0.1, 0.1])) < 0.01
    assert log.actions[0].shape == (7,) and log.grips == [-1]
    np.testing.assert_allclose(env.stored_qpos, env.qpos)
    stored = env.qpos
    demonstrator.hard_reset()
    demonstrator.hard_reset(qpos=env.stored_qpos)
    assert np.abs(env.qpos - stored).max() < 0.01


def test_the_stick_goes_around() -> None:
    env, log, demonstrator = scene(
        lambda env: [
            env.add(build_disc(env, name, 0.02, 0.01, "gray", xy))
            for name, xy in (("from", (-0.1, -0.07)), ("to", (-0.1, 0.07)))
        ],
        stick=True,
    )
    demonstrator.stick_to(things(env)["from"])
    before = len(log.actions)
    xs = []
    demonstrator.step = lambda action: (log._step(action), xs.append(env.tcp_pose.p[0]))
    demonstrator.stick_arc(things(env)["to"], "clockwise")
    assert len(log.actions) - before == 50
    assert distance_xy(env.tcp_pose.p, np.array([-0.1, 0.07])) < 0.03
    # Clockwise as the robot sees it is towards the robot when the way leads to the left.
    assert min(xs) < -0.17 and max(xs) < -0.08
    assert len(log.grips) == 3 and log.waypoints[1][0] == pytest.approx(-0.2, abs=0.01)


def test_arcs_on_both_sides_mirror_each_other() -> None:
    one = arc(np.array([0, 0]), np.array([0.1, 0]), "clockwise")
    other = arc(np.array([0, 0]), np.array([0.1, 0]), "counterclockwise")
    np.testing.assert_allclose(one, other * [1, -1, 1], atol=1e-12)
    assert one.shape == (45, 3) and one[22, 1] == pytest.approx(0.1)
