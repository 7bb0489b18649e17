"""What the four Unmask tasks share: containers over cubes, picking them up and putting
them down.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from mme_vla.envs.robomme.scene.motions import (
    COVER_STEPS,
    SWAP_STEPS,
    Cover,
    Cue,
    Hide,
    Swap,
    active_motions,
    planned_swaps,
    under,
)
from mme_vla.envs.robomme.scene.objects import (
    COLOURS,
    CONTAINER_OUTER,
    Container,
    Cube,
    H,
    build_container,
    build_hidden_cube,
)
from mme_vla.envs.robomme.scene.placement import (
    ANCHOR_HALF,
    Avoid,
    Draws,
    Point,
    Region,
    SceneError,
    draw_container,
)
from mme_vla.envs.robomme.scene.predicates import container_picked_up, container_put_down
from mme_vla.envs.robomme.tasks.families.stages import sample_colours
from mme_vla.envs.subtasks import Choice, SubTask
from mme_vla.envs.task import Task

UNMASK_COLOURS = ("red", "green", "blue")
MOST_PICKS = len(UNMASK_COLOURS)
PARKED: dict[str, int | None] = {"outer": 0, "outer cubes": 1, "inner": 2, "inner cubes": 3}
"""Groups of objects that are away at places of their own, in rows of RoboMME-OOD."""
# half of the side of the square in which more containers than the benchmark's stand, metres
WIDER = 0.25


def add_containers(
    env: Task,
    draws: Draws,
    count: int,
    avoid: Sequence[Avoid] = (),
    there: list[Container] | None = None,
) -> list[Container]:
    """Place containers in the middle of the table until there are `count` or one finds no place.

    Args:
        there: those that stand already, to which `count` more are added: closer together, and
            further out.
    """
    containers = [] if there is None else there
    half, gap = (0.2, 2 * H) if there is None else (WIDER, H)
    stop = len(containers) + count
    part = "layout.bins" if there is None else "layout.empty_bins"
    if env.values.specified:
        stop = len(containers) + env.values.count(part)
    first = len(containers)
    while len(containers) < stop:
        container = add_container(
            env,
            draws,
            f"{part}.{len(containers) - first}",
            Region((0, 0), half),
            [*avoid, *containers],
            gap,
            f"container_{len(containers)}",
        )
        if container is None:
            break
        containers.append(container)
    return containers


def add_container(
    env: Task,
    draws: Draws,
    value: str,
    region: Region,
    avoid: Sequence[Avoid],
    gap: float,
    name: str,
) -> Container | None:
    """Add a container at the row's place, or at a random one; None where it finds none."""
    if env.values.specified:
        place = env.values.place(value, list, size=3)
    else:
        sample = draw_container(draws, region, avoid, gap=gap, degrees=True)
        if sample is None:
            return None
        place = [*sample[0].tolist(), sample[1]]
        env.values.note(value, place)
    yaw = float(np.deg2rad(place[2]))
    env.values.occupy(value, place[:2], CONTAINER_OUTER / 2, yaw)
    return env.add(build_container(env, name, place[:2], yaw))


class OuterContainers:
    """Containers that stand around the inner ones and belong to none of the task's lists; some hide
    a cube.

    The row has them as `objects.distractors`, or `objects.distractors.public` where they change
    places.
    """

    def __init__(self, env: Task, draws: Draws) -> None:
        public = env.values.find("objects.distractors.public") is not None
        part = "objects.distractors.public" if public else "objects.distractors"
        count = env.values.count(f"{part}.bins")
        self.containers: list[Container] = []
        for i in range(count):
            added = add_container(
                env, draws, f"{part}.bins.{i}", Region((0, 0), 0), [], 0, f"distractor_bin_{i}"
            )
            assert added is not None
            self.containers.append(added)
        under = env.values.indices(f"{part}.cube_bins", list, count) if count else []
        colours = env.values.words(f"{part}.cube_colors", list, COLOURS) if count else []
        if len(colours) != len(under):
            raise env.values.error(
                f"{part}.cube_colors", f"has {len(colours)} colours for {len(under)} cubes"
            )
        self.hidden = []
        for j, (i, colour) in enumerate(zip(under, colours, strict=True)):
            place = self.containers[i].position[:2]
            cube = env.add(build_hidden_cube(env, f"distractor_cube_{j}_{colour}", colour, place))
            self.hidden.append((cube, self.containers[i]))


def add_hidden_cubes(
    env: Task, colours: Sequence[str], containers: Sequence[Container]
) -> list[Cube]:
    """Put a small cube of each colour under the container of the same index."""
    return [
        env.add(build_hidden_cube(env, f"cube_{colour}", colour, container.position[:2]))
        for colour, container in zip(colours, containers, strict=False)
    ]


def container_picks(
    env: Task,
    targets: Sequence[tuple[str, Container]],
    containers: Sequence[Container],
    letters: tuple[str, str] = ("a", "b"),
) -> list[SubTask]:
    """Pick up the container over each colour in turn, putting one down before the next.

    Args:
        env: the task.
        targets: colour and container, in order.
        containers: all of them; lifting another one fails.
        letters: multi-choice options of picking up and of putting down.
    """
    steps: list[SubTask] = []
    for colour, container in targets:
        if steps:
            steps.append(
                put_down_container(env, targets[len(steps) // 2][1], containers, letters[1])
            )
        steps.append(pick_up_container(colour, container, containers, letters[0]))
    return steps


def pick_up_container(
    colour: str, container: Container, containers: Sequence[Container], choice: str
) -> SubTask:
    """The sub-task of lifting the container over the cube of a colour; lifting another
    one fails.
    """
    return SubTask(
        f"pick up the container that hides the {colour} cube",
        done=lambda: container_picked_up(container),
        run=lambda demo: demo.pick_container(container),
        grounded=f"pick up the container at <> that hides the {colour} cube",
        failed=lambda: others_lifted(container, containers),
        targets=[container],
        choice=choice,
        pick=True,
        operation="where",
    )


def put_down_container(
    env: Task, container: Container, containers: Sequence[Container], choice: str
) -> SubTask:
    """The sub-task of putting a lifted container back; lifting another one fails."""
    return SubTask(
        "put down the container",
        done=lambda: container_put_down(env, container),
        run=lambda demo: demo.put_down(),
        failed=lambda: others_lifted(container, containers),
        targets=[container],
        choice=choice,
        operation="where",
    )


def others_lifted(container: Container, containers: Sequence[Container]) -> bool:
    """Whether a container other than the right one is up."""
    return any(container_picked_up(other) for other in containers if other is not container)


def hiding_goal(colours: Sequence[str]) -> str:
    """`pick up the container hiding the red cube`, and for a second colour another one."""
    goal = f"pick up the container hiding the {colours[0]} cube"
    for i, colour in enumerate(colours[1:], 2):
        word = "finally" if i == len(colours) else "next"
        goal += f", {word} pick up another container hiding the {colour} cube"
    return goal


def check_count(env: Task, count: int) -> None:
    """Refuse a row with fewer containers than hidden cubes."""
    if count < MOST_PICKS:
        raise env.values.error(
            "layout.bins", f"has {count} containers; expected at least {MOST_PICKS}"
        )


def container_choices(
    containers: Sequence[Container], letters: tuple[str, str] = ("a", "b")
) -> list[Choice]:
    """Pick up a container (which one, a pixel says), or put the held one down."""
    up, down = letters
    return [
        Choice(
            up,
            "pick up the container",
            lambda demo, thing: demo.pick_container(thing),
            lambda: containers,
        ),
        Choice(down, "put down the container", lambda demo, _: demo.put_down()),
    ]


STANDING = {"easy": 3, "medium": 5, "hard": 15}  # in hard episodes as many as fit
STANDING_PICKS = {"easy": 1, "medium": 1, "hard": 2}


class Unmask(Task):
    """Containers that stay where they are; what comes before the picks is for the task to say."""

    def build_containers(self, draws: Draws, avoid: Sequence[Avoid]) -> None:
        """Place the containers, hide the cubes under the first three, and add what a dial or a row
        adds.
        """
        self.containers = add_containers(self, draws, STANDING[self.difficulty], avoid)
        if self.values.specified:
            check_count(self, len(self.containers))
        self.colours = sample_colours(self, draws, UNMASK_COLOURS)
        self.pick_count = self.values.integer(
            "objects.n_picks", lambda: STANDING_PICKS[self.difficulty], least=1, most=MOST_PICKS
        )
        add_hidden_cubes(self, self.colours, self.containers)
        add_containers(self, draws, self.turned("containers"), avoid, self.containers)
        self.outer = OuterContainers(self, draws)

    @property
    def all_containers(self) -> list[Container]:
        """The inner ones and those around them: lifting a wrong one fails."""
        return [*self.containers, *self.outer.containers]

    @property
    def targets(self) -> list[tuple[str, Container]]:
        """Colours to be found, in order, each with the container over it."""
        return list(zip(self.colours, self.containers, strict=False))[: self.pick_count]

    def cues(self) -> list[Cue]:
        return [
            under(container, colour)
            for colour, container in zip(self.colours, self.containers, strict=False)
        ]

    def evidence(self, ended: Mapping[int, SubTask]) -> Collection[str]:
        return active_motions(self.covers[:1])

    def start_episode(self, draws: Draws) -> None:
        groups = PARKED if self.tier else dict.fromkeys(PARKED)
        self.covers = [
            Cover(self.containers, groups["inner"]),
            Cover(self.outer.containers, groups["outer"]),
        ]

    def before_physics(self, k: int) -> None:
        for cover in self.covers:
            cover.apply(k)


CONTAINERS = {"easy": 3, "medium": 4, "hard": 4}
SWAPS = {"easy": (1, 2), "medium": (1, 2), "hard": (2, 3)}  # fewest and most
PICKS = {"easy": (1, 2), "medium": (1, 1), "hard": (2, 2)}


class UnmaskSwap(Task):
    """Where the containers stand, and what comes before the picks, is for the task to say."""

    dials = frozenset({"swaps"})

    def plan(self, draws: Draws) -> None:
        low, high = SWAPS[self.difficulty]
        self.swap_count = draws.integer(low, high + 1)
        low, high = PICKS[self.difficulty]
        self.pick_count = self.values.integer(
            "objects.n_picks", lambda: draws.integer(low, high + 1), least=1, most=MOST_PICKS
        )

    def build_containers(
        self, draws: Draws, anchors: Sequence[Point], avoid: Sequence[Avoid] = ()
    ) -> None:
        """Place a container near each anchor, hide the cubes, and draw which containers will begin
        a swap.

        Raises:
            SceneError: a container finds no place.
        """
        self.containers: list[Container] = []
        count = self.values.count("layout.bins") if self.values.specified else len(anchors)
        for i in range(count):
            region = Region(anchors[min(i, len(anchors) - 1)], ANCHOR_HALF)
            container = add_container(
                self,
                draws,
                f"layout.bins.{i}",
                region,
                [*avoid, *self.containers],
                H,
                f"container_{i}",
            )
            if container is None:
                raise SceneError(f"No place for container {i} with seed {self.seed}.")
            self.containers.append(container)
        check_count(self, count)
        self.colours = sample_colours(self, draws, UNMASK_COLOURS)
        over = self.values.indices("objects.selected", lambda: draws.permutation(3), count)
        if len(over) != len(self.colours):
            raise self.values.error(
                "objects.selected", f"has {len(over)} containers for {len(self.colours)} cubes"
            )
        self.over_cubes = [self.containers[i] for i in over]
        self.cubes = add_hidden_cubes(self, self.colours, self.over_cubes)
        self._plan_swaps(draws, count)
        self.outer = OuterContainers(self, draws)
        self.outer_pairs = (
            self.values.pairs("actions.distractor_swap_pairs", len(self.outer.containers)) or []
        )
        if len(self.outer_pairs) > self.swap_count:
            problem = f"has {len(self.outer_pairs)} swaps, more than objects.n_swaps"
            raise self.values.error("actions.distractor_swap_pairs", problem)

    def _plan_swaps(self, draws: Draws, count: int) -> None:
        """Which containers change places: both of a row's pair, or an initiator and whichever is
        nearest then.
        """
        self.swap_steps = self.values.integer(
            "actions.swap_window.duration_steps", lambda: SWAP_STEPS, least=1
        )
        self.pairs = self.values.pairs("actions.swap_pairs", count)
        initiators = []
        if self.pairs is None:
            sampled = [] if self.values.specified else self._draw_initiators(draws, count)
            initiators = self.values.indices(
                "actions.swap_initiators", lambda: sampled, count, distinct=False
            )
        self.initiators = [self.containers[i] for i in initiators]
        swaps = initiators if self.pairs is None else self.pairs
        self.swap_count = self.values.integer("objects.n_swaps", lambda: len(swaps))
        if self.swap_count != len(swaps):
            name = "actions.swap_initiators" if self.pairs is None else "actions.swap_pairs"
            raise self.values.error(
                "objects.n_swaps", f"is {self.swap_count}, and {name} has {len(swaps)} swaps"
            )

    def _draw_initiators(self, draws: Draws, count: int) -> list[int]:
        draws.integer(0, count)  # part of the official stream, without effect
        initiators = draws.permutation(3)[:2]
        others = [i for i in range(count) if i not in initiators]
        initiators.append(others[draws.integer(0, len(others))])
        initiators = initiators[: self.swap_count]
        return initiators + [draws.integer(0, count) for _ in range(self.turned("swaps"))]

    def cues(self) -> list[Cue]:
        return [
            under(container, colour)
            for colour, container in zip(self.colours, self.over_cubes, strict=True)
        ]

    @property
    def swapped_after(self) -> int:
        """The step at which the last swap ends."""
        return COVER_STEPS + self.swap_steps * self.swap_count

    @property
    def targets(self) -> list[tuple[str, Container]]:
        """Colours to be found, in order, each with the container over it."""
        return list(zip(self.colours, self.over_cubes, strict=True))[: self.pick_count]

    def evidence(self, ended: Mapping[int, SubTask]) -> Collection[str]:
        return active_motions(self.visible_motions)

    def start_episode(self, draws: Draws) -> None:
        inner, outer = self.containers, self.outer.containers
        start, steps, end = COVER_STEPS, self.swap_steps, self.swapped_after
        groups = PARKED if self.tier else dict.fromkeys(PARKED)
        nearest = [
            Swap(thing, inner, start + i * steps, steps=steps)
            for i, thing in enumerate(self.initiators)
        ]
        swaps = nearest if self.pairs is None else planned_swaps(self.pairs, inner, start, steps)
        cover = Cover(inner, groups["inner"])
        self.visible_motions: list[Cover | Swap] = [cover, *swaps]
        self.motions: list[Cover | Swap | Hide] = [
            cover,
            Cover(outer, groups["outer"]),
            *swaps,
            *planned_swaps(self.outer_pairs, outer, start, steps),
            Hide(
                list(zip(self.cubes, self.over_cubes, strict=True)),
                start,
                end,
                groups["inner cubes"],
            ),
            Hide(self.outer.hidden, start, end, groups["outer cubes"]),
        ]

    @property
    def all_containers(self) -> list[Container]:
        """The inner ones and those around them: lifting a wrong one fails."""
        return [*self.containers, *self.outer.containers]

    def before_physics(self, k: int) -> None:
        for motion in self.motions:
            motion.apply(k)
