"""Sub-tasks and placements that several tasks share."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mme_vla.envs.scene.articulated import Button
from mme_vla.envs.scene.objects import Cube, H, build_cube
from mme_vla.envs.scene.placement import Avoid, Draws, Region, SceneError, draw_cube
from mme_vla.envs.scene.predicates import StaticFor, picked_up, pressed, reset_reached
from mme_vla.envs.scene.stage import RESET_QPOS
from mme_vla.envs.subtasks import NO_RECORD, SubTask
from mme_vla.envs.task import Task

if TYPE_CHECKING:
    from mme_vla.envs.robot.demonstrator import Demonstrator


def add_cube(
    env: Task, draws: Draws, name: str, colour: str, region: Region, avoid: Sequence[Avoid], gap: float = H
) -> Cube:
    """Add a cube at a random place; raises `SceneError` where it finds none."""
    place = draw_cube(draws, region, avoid, gap=gap)
    if place is None:
        raise SceneError(f"{type(env).__name__}, seed {env.seed}: {name} finds no place.")
    return env.add(build_cube(env, name, colour, *place))


def press(button: Button, text: str, choice: str, **options: Any) -> SubTask:
    """Press a button; the pixel stands behind the word `button`."""
    return SubTask(
        text,
        done=lambda: pressed(button),
        run=lambda demo: demo.press(button),
        targets=[button],
        choice=choice,
        **{"grounded": text.replace("button", "button at <>", 1), **options},
    )


def pick(env: Task, cube: Cube, text: str, choice: str = "a", **options: Any) -> SubTask:
    """Pick up a cube; the pixel stands behind the word `cube`."""
    return SubTask(
        text,
        done=lambda: picked_up(env, cube),
        run=lambda demo: demo.pick(cube),
        targets=[cube],
        choice=choice,
        **{"grounded": text.replace("cube", "cube at <>", 1), **options},
    )


def wait(env: Task, steps: int) -> SubTask:
    """Hold still in the video."""
    return SubTask("static", StaticFor(env, steps), lambda demo: demo.hold(steps), video=True)


def go_home(env: Task, steps: int) -> SubTask:
    """Move above the middle of the table in the video, then hold still."""

    def run(demo: "Demonstrator") -> None:
        demo.go_home()
        demo.hold(steps)

    return SubTask("static", StaticFor(env, steps), run, video=True)


def end_video(env: Task) -> SubTask:
    """Drive the arm back to its start between the video and the execution."""
    return SubTask(
        NO_RECORD,
        done=lambda: env.after_video and reset_reached(env, env.reset_action[:-1]),
        run=lambda demo: demo.hard_reset(),
        video=True,
    )


def end_stick_video(env: Task, steps: int = 30) -> list[SubTask]:
    """Drive the arm home, and then to where its first approach ended."""
    return [
        SubTask(
            NO_RECORD,
            done=lambda: env.after_video and reset_reached(env, RESET_QPOS),
            run=lambda demo: demo.hard_reset(steps),
            video=True,
        ),
        SubTask(
            NO_RECORD,
            done=lambda: env.stored_qpos is not None and reset_reached(env, env.stored_qpos),
            run=lambda demo: demo.hard_reset(qpos=env.stored_qpos),
            video=True,
        ),
    ]
