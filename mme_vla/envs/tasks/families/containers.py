"""What the four Unmask tasks share: containers over cubes, picking them up and putting them down."""

from collections.abc import Sequence

from mme_vla.envs.choices import Choice
from mme_vla.envs.scene.draws import Draws
from mme_vla.envs.scene.objects import Container, Cube, H, build_container, build_hidden_cube
from mme_vla.envs.scene.placement import Avoid, Region, draw_container
from mme_vla.envs.scene.predicates import container_picked_up, container_put_down
from mme_vla.envs.subtasks import SubTask
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
