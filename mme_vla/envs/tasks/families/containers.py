"""What the four Unmask tasks share: containers over cubes, picking them up and putting them down."""

from collections.abc import Sequence

from mme_vla.envs.scene.motions import COVER_STEPS, SWAP_STEPS, Cover, Cue, Hide, Swap, sequential_swaps, under
from mme_vla.envs.scene.objects import Container, Cube, H, build_container, build_hidden_cube
from mme_vla.envs.scene.placement import (
    ANCHOR_HALF,
    Avoid,
    Draws,
    Point,
    Region,
    SceneError,
    draw_container,
)
from mme_vla.envs.scene.predicates import container_picked_up, container_put_down
from mme_vla.envs.subtasks import Choice, SubTask
from mme_vla.envs.task import Task

WIDER = 0.25  # half of the side of the square in which more containers than the benchmark's stand, metres


def add_containers(
    env: Task, draws: Draws, count: int, avoid: Sequence[Avoid] = (), there: list[Container] | None = None
) -> list[Container]:
    """Place containers in the middle of the table until there are `count` or one finds no place.

    Args:
        there: those that stand already, to which `count` more are added: closer together, and further out.
    """
    containers = [] if there is None else there
    half, gap = (0.2, 2 * H) if there is None else (WIDER, H)
    stop = len(containers) + count
    while len(containers) < stop:
        place = draw_container(draws, Region((0, 0), half), [*avoid, *containers], gap=gap)
        if place is None:
            break
        containers.append(env.add(build_container(env, f"container_{len(containers)}", *place)))
    return containers


def add_hidden_cubes(env: Task, colours: Sequence[str], containers: Sequence[Container]) -> list[Cube]:
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
            steps.append(put_down_container(env, targets[len(steps) // 2][1], containers, letters[1]))
        steps.append(pick_up_container(colour, container, containers, letters[0]))
    return steps


def pick_up_container(colour: str, container: Container, containers: Sequence[Container], choice: str) -> SubTask:
    """The sub-task of lifting the container over the cube of a colour; lifting another one fails."""
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


def put_down_container(env: Task, container: Container, containers: Sequence[Container], choice: str) -> SubTask:
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
    return goal if len(colours) == 1 else f"{goal}, finally pick up another container hiding the {colours[1]} cube"


def container_choices(containers: Sequence[Container], letters: tuple[str, str] = ("a", "b")) -> list[Choice]:
    """Pick up a container (which one, a pixel says), or put the held one down."""
    up, down = letters
    return [
        Choice(up, "pick up the container", lambda demo, thing: demo.pick_container(thing), lambda: containers),
        Choice(down, "put down the container", lambda demo, _: demo.put_down()),
    ]


CONTAINERS = {"easy": 3, "medium": 4, "hard": 4}
SWAPS = {"easy": (1, 2), "medium": (1, 2), "hard": (2, 3)}  # fewest and most
PICKS = {"easy": (1, 2), "medium": (1, 1), "hard": (2, 2)}


class UnmaskSwap(Task):
    """Where the containers stand, and what comes before the picks, is for the task to say."""

    dials = frozenset({"swaps"})

    def plan(self, draws: Draws) -> None:
        self.swap_count, self.pick_count = (
            draws.integer(low, high + 1) for low, high in (SWAPS[self.difficulty], PICKS[self.difficulty])
        )

    def build_containers(self, draws: Draws, anchors: Sequence[Point], avoid: Sequence[Avoid] = ()) -> None:
        """Place a container near each anchor, hide the cubes, and draw which containers will begin a swap.

        Raises:
            SceneError: a container finds no place.
        """
        self.containers: list[Container] = []
        for anchor in anchors:
            place = draw_container(draws, Region(anchor, ANCHOR_HALF), [*avoid, *self.containers], gap=H)
            if place is None:
                raise SceneError(f"No place for container {len(self.containers)} with seed {self.seed}.")
            self.containers.append(self.add(build_container(self, f"container_{len(self.containers)}", *place)))
        self.colours = [("red", "green", "blue")[i] for i in draws.permutation(3)]
        self.over_cubes = [self.containers[i] for i in draws.permutation(3)]
        self.cubes = add_hidden_cubes(self, self.colours, self.over_cubes)
        draws.integer(0, len(anchors))  # part of the official stream, without effect
        initiators = draws.permutation(3)[:2]
        others = [i for i in range(len(anchors)) if i not in initiators]
        initiators.append(others[draws.integer(0, len(others))])
        self.initiators = [self.containers[i] for i in initiators[: self.swap_count]]
        for _ in range(self.turned("swaps")):
            self.initiators.append(self.containers[draws.integer(0, len(anchors))])
        self.swap_count = len(self.initiators)

    def cues(self) -> list[Cue]:
        return [under(container, colour) for colour, container in zip(self.colours, self.over_cubes, strict=True)]

    @property
    def swapped_after(self) -> int:
        """The step at which the last swap ends."""
        return COVER_STEPS + SWAP_STEPS * self.swap_count

    @property
    def targets(self) -> list[tuple[str, Container]]:
        """Colours to be found, in order, each with the container over it."""
        return list(zip(self.colours, self.over_cubes, strict=True))[: self.pick_count]

    def start_episode(self, draws: Draws) -> None:
        self.motions: list[Cover | Swap | Hide] = [
            Cover(self.containers),
            *sequential_swaps(self.initiators, self.containers, COVER_STEPS),
            Hide(list(zip(self.cubes, self.over_cubes, strict=True)), COVER_STEPS, self.swapped_after),
        ]

    def before_physics(self, k: int) -> None:
        for motion in self.motions:
            motion.apply(k)
