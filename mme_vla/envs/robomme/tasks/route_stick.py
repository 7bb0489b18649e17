"""RouteStick (Imitation): the video winds around obstacles from disc to disc; follow the same
route.
"""

import itertools
import math
from functools import partial
from typing import Any, Literal

import numpy as np

from mme_vla.envs.robomme.robot.demonstrator import Demonstrator, arc
from mme_vla.envs.robomme.scene.motions import Cue, Place, on_table
from mme_vla.envs.robomme.scene.objects import Disc, build_disc, build_obstacle
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.scene.predicates import over
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stick import StickTask
from mme_vla.envs.subtasks import Choice, SubTask

PLACES, SPACING, CENTRE_X = 9, 0.07, -0.1
MOVES = {"easy": (2, 3), "medium": (4, 5), "hard": (4, 7)}
CUE_RADIUS, DOT_RADIUS = 0.04, 0.01
DOTS = range(8, 40, 7)  # of an arc's 45 points
MOVE = "move to the nearest {} target by circling around the stick {}"
Direction = Literal["clockwise", "counterclockwise"]
TURNS = dict.fromkeys(("clockwise", "counterclockwise"))
SIDES: tuple[tuple[str, Direction], ...] = (
    ("left", "clockwise"),
    ("right", "clockwise"),
    ("left", "counterclockwise"),
    ("right", "counterclockwise"),
)


@register_task
class RouteStick(StickTask):
    """Five discs in a row with an obstacle between each two; left is the larger y."""

    visit = (0.03, 0.15)
    home_steps = 200
    latch_failure = True

    def build(self, draws: Draws) -> None:
        angle = math.radians(
            self.values.number("layout.rotation_deg", lambda: -30 + 60 * draws.uniform())
        )
        cos, sin = math.cos(angle), math.sin(angle)
        places: list[np.ndarray] = []
        self.all_discs: list[Disc] = []
        for i in range(PLACES):
            y = (i - PLACES // 2) * SPACING
            places.append(np.array([cos * CENTRE_X - sin * y, sin * CENTRE_X + cos * y]))
            z = -0.01 if i % 2 else 0.01  # under an obstacle no disc is to be seen
            disc = build_disc(self, f"disc_{i}", 0.02, 0.01, "gray", places[i], z)
            self.all_discs.append(self.add(disc))
        for i in range(1, PLACES, 2):
            colour = self.values.colour(
                f"layout.obstacle_rgb.{i // 2}", lambda: draws.uniforms(3).tolist()
            )
            self.add(build_obstacle(self, f"obstacle_{i // 2}", places[i], angle, colour))
        self.discs = self.all_discs[::2]
        self._draw_route(draws)
        self.add_marks()

    def _draw_route(self, draws: Draws) -> None:
        """The row's route and turns, or random ones."""
        values, count = self.values, len(self.discs)
        route = values.indices(
            "actions.route", lambda: self._sample_route(draws), count, distinct=False
        )
        moves = len(route) - 1
        values.require(
            moves > 0 and all(abs(a - b) == 1 for a, b in itertools.pairwise(route)),
            "actions.route",
            f"is {route}; expected a way from disc to neighbouring disc",
        )

        def sample() -> list[str]:
            return ["clockwise" if draws.coin() else "counterclockwise" for _ in range(moves)]

        self.path = [self.discs[i] for i in route]
        self.directions: list[Direction] = values.words("actions.turns", sample, TURNS)  # type: ignore[assignment]
        count = len(self.directions)
        values.require(count == moves, "actions.turns", f"has {count} turns for {moves} moves")

    def _sample_route(self, draws: Draws) -> list[int]:
        low, high = MOVES[self.difficulty]
        moves = draws.integer(low, high + 1)
        route = [draws.integer(0, len(self.discs))]
        for _ in range(moves):
            nearby = [i for i in (route[-1] - 1, route[-1] + 1) if 0 <= i < len(self.discs)]
            if self.difficulty != "hard" and len(route) > 1 and len(nearby) > 1:
                nearby.remove(route[-2])
            route.append(nearby[draws.integer(0, len(nearby))])
        return route

    def flip_fact(self) -> dict[str, Any] | None:
        """The route mirrored at its first disc, with the same turns; None where it leaves the
        discs.
        """
        route = [self.discs.index(disc) for disc in self.path]
        mirrored = [2 * route[0] - i for i in route]
        if not all(0 <= i < len(self.discs) for i in mirrored):
            return None
        return self.values.changed({"actions.route": mirrored})

    def beside(self, here: Disc) -> list[Disc]:
        i = self.discs.index(here)
        return self.discs[max(i - 1, 0) : i] + self.discs[i + 1 : i + 2]

    def cues(self) -> list[Cue]:
        """Of the next move: a disc under its target, and smaller ones along its arc."""
        cues = [Cue("yellow", partial(self._arc_point, -1), CUE_RADIUS)]
        for i in DOTS:
            cues.append(Cue("yellow", partial(self._arc_point, i), DOT_RADIUS))
        return cues

    def _arc_point(self, i: int) -> Place | None:
        """A point of the next move's arc."""
        move = len(self.directions) - len(self.progress.to_come)
        if not 0 <= move < len(self.directions):  # in the video, or at the end
            return None
        start, end = self.path[move].position, self.path[move + 1].position
        return on_table(arc(start, end, self.directions[move])[i])

    def start_episode(self, draws: Draws) -> None:
        super().start_episode(draws)
        self._way: list[np.ndarray] = []
        self._way_of: SubTask | None = None

    def failure(self) -> bool:
        """Remembers the way of the tool since the last visit; the rules belong to the moves."""
        if self.progress.current is not self._way_of:
            self._way_of = self.progress.current
            self._way = []
        self._way.append(np.asarray(self.tcp_pose.p[:2], np.float64))
        return False

    def _turned(self, previous: Disc, goal: Disc) -> Direction:
        """How the tool went around what lies between two discs: on which side of the chord it was
        on average.
        """
        way = np.mean(self._way, axis=0) - previous.position[:2]
        chord = goal.position[:2] - previous.position[:2]
        return "clockwise" if chord[0] * way[1] - chord[1] * way[0] > 0 else "counterclockwise"

    def moves(self, video: bool) -> list[SubTask]:
        legs = zip(self.path, self.path[1:], self.directions, strict=False)
        return [self._move(*leg, video) for leg in legs]

    def _move(self, previous: Disc, goal: Disc, direction: Direction, video: bool) -> SubTask:
        others = [disc for disc in self.all_discs if disc is not previous and disc is not goal]
        side = "left" if goal.position[1] > previous.position[1] else "right"

        def failed() -> bool:
            if any(over(self.tcp_pose.p, disc) for disc in others):
                return True
            return self.visited_now(goal) and self._turned(previous, goal) != direction

        return SubTask(
            MOVE.format(side, direction),
            done=lambda: self.visited_now(goal),
            run=lambda demo: demo.stick_arc(goal, direction),
            failed=failed,
            choice="abcd"[SIDES.index((side, direction))],
            video=video,
            operation=lambda: "how" if self.visited_now(goal) else "order",
        )

    def choices(self) -> list[Choice]:
        return [
            Choice(letter, MOVE.format(side, direction), partial(self._go, side, direction))
            for letter, (side, direction) in zip("abcd", SIDES, strict=True)
        ]

    def _go(self, side: str, direction: Direction, demo: Demonstrator, _: None) -> None:
        tcp = self.tcp_pose.p
        here = min(range(len(self.discs)), key=lambda i: distance_xy(self.discs[i].position, tcp))
        there = here + 1 if side == "left" else here - 1
        if 0 <= there < len(self.discs):
            demo.stick_arc(self.discs[there], direction)

    def goals(self) -> list[str]:
        around = "use the stick attached to the robot to navigate around the sticks on the table"
        goal = f"watch the video carefully, then {around}, following the same path"
        return [goal, f"{goal} shown in the video"]
