"""Sub-tasks and placements that several tasks share."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mme_vla.envs.robomme.scene.articulated import BUTTON_BASE, Button, build_button
from mme_vla.envs.robomme.scene.objects import COLOURS, RGB, Cube, Disc, H, build_cube, build_disc
from mme_vla.envs.robomme.scene.placement import (
    Avoid,
    Draws,
    Region,
    SceneError,
    draw_button,
    draw_cube,
    draw_disc,
)
from mme_vla.envs.robomme.scene.predicates import StaticFor, picked_up, pressed, reset_reached
from mme_vla.envs.robomme.scene.stage import RESET_QPOS
from mme_vla.envs.subtasks import NO_RECORD, SubTask
from mme_vla.envs.task import Task

if TYPE_CHECKING:
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator

TARGET_THICKNESS = 0.005


def add_cube(
    env: Task,
    draws: Draws,
    name: str,
    colour: str | RGB,
    region: Region,
    avoid: Sequence[Avoid],
    gap: float = H,
    value: str = "",
) -> Cube:
    """Add a cube at the place that the row gives as `value`, or at a random one; `SceneError` where
    it finds none.
    """

    def sample() -> list[float]:
        place = draw_cube(draws, region, avoid, gap=gap)
        if place is None:
            raise SceneError(f"{type(env).__name__}, seed {env.seed}: {name} finds no place.")
        return [*place[0], place[1]]

    x, y, yaw = env.values.place(value, sample, size=3)
    env.values.occupy(value, (x, y), H, yaw)
    return env.add(build_cube(env, name, colour, (x, y), yaw))


def add_button(
    env: Task,
    draws: Draws,
    centre: tuple[float, float],
    spread: tuple[float, float] = (0.1, 0.4),
    name: str = "button",
    value: str = "layout.button_xy",
) -> Button:
    """Add a button at the row's place, or at a random one in a rectangle of these
    widths, metres.
    """
    xy = env.values.place(value, lambda: draw_button(draws, centre, spread))
    env.values.occupy(value, xy, BUTTON_BASE[0])
    return env.add(build_button(env, xy, name))


def add_target(
    env: Task,
    draws: Draws,
    name: str,
    value: str,
    region: Region,
    radius: float,
    avoid: Sequence[Avoid],
    gap: float,
    colour: str = "purple",
) -> Disc:
    """Add a target at the row's place, or at a random one; raises `SceneError` where
    it finds none.
    """

    def sample() -> np.ndarray:
        xy = draw_disc(draws, region, radius, avoid, gap=gap)
        if xy is None:
            raise SceneError(f"{type(env).__name__}, seed {env.seed}: {name} finds no place.")
        return xy

    return env.add(
        build_disc(env, name, radius, TARGET_THICKNESS, colour, env.values.place(value, sample))
    )


def sample_colours(env: Task, draws: Draws, order: Sequence[str]) -> list[str]:
    """The colours in the row's order, or in a random one."""
    numbers = env.values.indices(
        "objects.color_order", lambda: draws.permutation(len(order)), len(order)
    )
    if env.values.find("objects.colors") is None:
        return [order[i] for i in numbers]
    return env.values.words("objects.colors", list, dict.fromkeys(order))


def check_colour(env: Task, colour: str | RGB) -> None:
    """Refuse a row whose `target_color`, if it has one, is not the colour that its other values
    give.
    """
    stated = env.values.find("objects.target_color")
    if stated not in (None, colour):
        raise env.values.error(
            "objects.target_color", f"is {stated!r}; the other values give {colour!r}"
        )


def cube_names(env: Task, part: str, colours: Sequence[str]) -> list[str]:
    """Names such as `red_0` of the cubes in a part of the row; without a row one of each of these
    colours.
    """
    names = (
        env.values.names(part) if env.values.specified else [f"{colour}_0" for colour in colours]
    )
    for name in names:
        if name.split("_")[0] not in COLOURS:
            raise env.values.error(
                f"{part}.{name}", f"has an unknown colour; expected one of {', '.join(COLOURS)}"
            )
    return names


def add_distractors(env: Task, draws: Draws, region: Region) -> list[Cube]:
    """Add the cubes of other colours that a row has: each is a wrong cube."""
    part = "layout.distractors"
    return [
        add_cube(
            env, draws, f"distractor_{name}", name.split("_")[0], region, [], value=f"{part}.{name}"
        )
        for name in cube_names(env, part, [])
    ]


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


def choices_made(ended: Mapping[int, SubTask], letters: str, video: bool) -> set[str]:
    """Of the sub-tasks that have ended, those of the video or of the execution that are one of some
    options.
    """
    return {
        f"{i} {s.text}"
        for i, s in ended.items()
        if s.choice and s.choice in letters and s.video == video
    }


def delay(env: Task) -> int:
    """Steps more between what is shown and the execution: a dial, or a value of the row."""
    turned = env.turned("delay")
    return (
        turned
        if not turned and not env.values.specified
        else env.values.integer("actions.delay", lambda: turned, default=0)
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
