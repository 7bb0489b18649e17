"""What VideoUnmaskSwap and ButtonUnmaskSwap share: containers cover three cubes, then change places with them."""

from collections.abc import Sequence

from mme_vla.envs.scene.cues import Cue, under
from mme_vla.envs.scene.draws import Draws
from mme_vla.envs.scene.motions import COVER_STEPS, SWAP_STEPS, Cover, Hide, Swap
from mme_vla.envs.scene.objects import Container, H, build_container
from mme_vla.envs.scene.placement import ANCHOR_HALF, Avoid, Point, Region, SceneError, draw_container, sequential_swaps
from mme_vla.envs.task import Task
from mme_vla.envs.tasks.families.containers import add_hidden_cubes

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
