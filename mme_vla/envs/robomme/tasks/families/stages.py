"""Sub-tasks, options and placements that several tasks share."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mme_vla.envs.facts import VisibleFact
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.articulated import BUTTON_BASE, Button, build_button
from mme_vla.envs.robomme.scene.motions import Swap, active_motions
from mme_vla.envs.robomme.scene.objects import COLOURS, RGB, Cube, Disc, H, build_cube, build_disc
from mme_vla.envs.robomme.scene.placement import (
    Avoid,
    Draws,
    Region,
    draw_button,
    draw_cube,
    draw_disc,
)
from mme_vla.envs.robomme.scene.predicates import (
    StaticFor,
    dropped,
    dropped_onto,
    picked_up,
    pressed,
    reset_reached,
)
from mme_vla.envs.robomme.scene.things import Thing
from mme_vla.envs.subtasks import NO_RECORD, Choice, SubTask
from mme_vla.envs.task import Task

SAMPLED_COLOURS = ("red", "blue", "green")
"""The colours of cubes in the order in which the benchmark samples them."""
TARGET_THICKNESS = 0.005
RELEASE_Z = 0.07
"""Height of the tool where it lets a cube go, unless a task has its own, metres."""

# Placements ---------------------------------------------------------------------------------------


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
    """Add a cube at the place that the row gives as `value`, or at a random one.

    Raises:
        SceneError: no place is free.
    """

    def sample() -> list[float]:
        xy, yaw = draw_cube(draws, region, avoid, gap, f"{env.where}: {name}")
        return [*xy, yaw]

    x, y, yaw = env.values.place(value, sample, size=3)
    env.values.occupy(value, (x, y), H, yaw)
    return env.add(build_cube(env, name, colour, (x, y), yaw))


def add_cubes(
    env: Task, draws: Draws, colours: Sequence[str], region: Region, avoid: Sequence[Avoid]
) -> list[Cube]:
    """Add the cubes of the row, or one of each of these colours; they keep clear of each other."""
    names = [(f"{colour}_0", colour) for colour in colours]
    if env.values.specified:
        names = names_with_colours(env, "layout.cubes")
    cubes: list[Cube] = []
    for name, colour in names:
        value = f"layout.cubes.{name}"
        taken = [*avoid, *cubes]
        cubes.append(add_cube(env, draws, f"cube_{colour}", colour, region, taken, value=value))
    return cubes


def names_with_colours(env: Task, part: str) -> list[tuple[str, str]]:
    """Names such as `red_0` of the cubes in a part of the row, each with its colour."""
    names = []
    for name in env.values.names(part):
        colour = name.split("_")[0]
        env.values.require(
            colour in COLOURS,
            f"{part}.{name}",
            f"has an unknown colour; expected one of {', '.join(COLOURS)}",
        )
        names.append((name, colour))
    return names


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
    """Add a target at the row's place, or at a random one.

    Raises:
        SceneError: no place is free.
    """
    xy = env.values.place(
        value, lambda: draw_disc(draws, region, radius, avoid, gap, f"{env.where}: {name}")
    )
    return env.add(build_disc(env, name, radius, TARGET_THICKNESS, colour, xy))


# Values -------------------------------------------------------------------------------------------


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
    env.values.require(
        stated in (None, colour),
        "objects.target_color",
        f"is {stated!r}; the other values give {colour!r}",
    )


class VideoSwaps(Task):
    """A task in whose video objects change places, from the step after a stage is entered."""

    swap_stage: SubTask | None
    """Set by `subtasks`; None where nothing changes places."""

    @abstractmethod
    def make_swaps(self, start: int) -> list[Swap]:
        """The swaps of the episode, the first of which begins at step `start`."""

    def start_episode(self, draws: Draws) -> None:
        self.swaps: list[Swap] = []
        self._swaps_due = False

    def failure(self) -> bool:
        """Notes whether the swaps may begin; the rules belong to the stages."""
        self._swaps_due = self.swap_stage is not None and self.progress.current is self.swap_stage
        return False

    def before_physics(self, k: int) -> None:
        if self._swaps_due and not self.swaps:
            self.swaps = self.make_swaps(k)
            self.motions = [*self.swaps]
        super().before_physics(k)

    def visible_facts(self, ended: Mapping[int, SubTask]) -> dict[str, VisibleFact]:
        return super().visible_facts(ended) | active_motions(self.swaps)


def read_swaps[T: Thing](
    env: Task, things: Sequence[T], sample: Callable[[], list[int]], distinct: bool = True
) -> list[tuple[T, T | None]]:
    """The swaps in order, as `consecutive_swaps` takes them: both objects of the row's pairs, or
    initiators alone, whose partner is whichever is nearest then.

    Args:
        things: the objects that change places.
        sample: indices of the initiators.
        distinct: each object begins one swap at most.
    """
    values, count = env.values, len(things)
    swaps: list[tuple[T, T | None]] = []
    name = "actions.swap_pairs"
    pairs = values.pairs(name, count)
    if pairs is not None:
        for first, second in pairs:
            swaps.append((things[first], things[second]))
    else:
        name = "actions.swap_initiators"
        for i in values.indices(name, sample, count, distinct):
            swaps.append((things[i], None))
    stated = values.integer("objects.n_swaps", lambda: len(swaps))
    values.require(
        stated == len(swaps), "objects.n_swaps", f"is {stated}, and {name} has {len(swaps)} swaps"
    )
    return swaps


def delay(env: Task) -> int:
    """Steps more between what is shown and the execution: a dial, or a value of the row."""
    turned = env.turned("delay")
    if not turned and not env.values.specified:
        return 0  # the values of such a scene do not name it
    return env.values.integer("actions.delay", lambda: turned, default=0)


# Sub-tasks ----------------------------------------------------------------------------------------


# `details` are further fields of `SubTask`.


def press(button: Button, text: str, choice: str, **details: Any) -> SubTask:
    """Press a button; the pixel stands behind the word `button`."""
    details.setdefault("grounded", text.replace("button", "button at <>", 1))
    return SubTask(
        text,
        done=lambda: pressed(button),
        run=lambda demo: demo.press(button),
        targets=[button],
        choice=choice,
        **details,
    )


def pick(env: Task, cube: Cube, text: str, choice: str = "a", **details: Any) -> SubTask:
    """Pick up a cube; the pixel stands behind the word `cube`."""
    details.setdefault("grounded", text.replace("cube", "cube at <>", 1))
    return SubTask(
        text,
        done=lambda: picked_up(env, cube),
        run=lambda demo: demo.pick(cube),
        targets=[cube],
        choice=choice,
        **details,
    )


def put_down(
    env: Task,
    cube: Cube,
    text: str,
    choice: str,
    z: float = RELEASE_Z,
    **details: Any,
) -> SubTask:
    """Put the held cube down where it is, the tool at height `z` in metres."""
    return SubTask(
        text,
        done=lambda: dropped(env, cube),
        run=lambda demo: demo.put_down(z),
        targets=[cube],
        choice=choice,
        **details,
    )


def place(
    env: Task,
    cube: Cube,
    target: Thing,
    text: str,
    choice: str = "b",
    **details: Any,
) -> SubTask:
    """Place the held cube onto a target; the pixel stands behind the word `target`."""
    details.setdefault("grounded", text.replace("target", "target at <>", 1))
    return SubTask(
        text,
        done=lambda: dropped_onto(env, cube, target),
        run=lambda demo: demo.place_on(target),
        targets=[target],
        choice=choice,
        **details,
    )


def wait(env: Task, steps: int) -> SubTask:
    """Hold still in the video."""
    return SubTask("static", StaticFor(env, steps), lambda demo: demo.hold(steps), video=True)


def go_home(env: Task, steps: int) -> SubTask:
    """Move above the middle of the table in the video, then hold still."""

    def run(demo: Demonstrator) -> None:
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


# Options of multi-choice --------------------------------------------------------------------------


def press_choice(label: str, text: str, button: Button) -> Choice:
    """The option of pressing a button."""
    return Choice(label, text, lambda demo, _: demo.press(button))


def put_down_choice(label: str, text: str, z: float = RELEASE_Z) -> Choice:
    """The option of putting down what is held, the tool at height `z` in metres."""
    return Choice(label, text, lambda demo, _: demo.put_down(z))
