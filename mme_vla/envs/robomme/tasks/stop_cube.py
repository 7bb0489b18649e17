"""StopCube (Counting): a cube goes back and forth over a target; stop it there on the
right visit.
"""

import math
from collections.abc import Mapping

import numpy as np
import sapien

from mme_vla.envs.facts import VisibleFact
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import Cue, row, smoothstep, tally
from mme_vla.envs.robomme.scene.objects import build_disc, build_moving_cube
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.scene.predicates import hovering, pressed
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import add_button
from mme_vla.envs.subtasks import Choice, SubTask, ordinal
from mme_vla.envs.task import Task

INTERVALS = (60, 80, 120)  # steps of one pass
PASSES = 5
REACH = 0.3  # from the target to either end of the line
STOPPED_AT = 0.06
LEAD = 30  # steps before the crossing at which the demonstrator begins to press
PRESS_STEPS = 29  # from the beginning of a press until the button is down, usually
CHECKPOINT = 100


@register_task
class StopCube(Task):
    """The difficulty changes nothing."""

    latch_failure = True

    def build(self, draws: Draws) -> None:
        self.passes = self.values.integer(
            "actions.motion_segments", lambda: PASSES + self.turned("count"), least=1
        )
        self.button = add_button(self, draws, (-0.2, 0))
        xy = self.values.place(
            "layout.target_xy", lambda: [draws.between(-0.1, 0.1), draws.between(-0.1, 0.1)]
        )
        self.target = self.add(build_disc(self, "target", 0.036, 0.01, "purple", xy))
        colour = self.values.colour("objects.cube_rgb", lambda: draws.uniforms(3).tolist())
        self.cube = self.add(build_moving_cube(self, "cube", colour, xy, z=0.01))

    def start_episode(self, draws: Draws) -> None:
        values = self.values
        draws = Draws(self.seed)
        draws.integer(27, 33)  # part of the official stream, without effect
        self.interval = values.integer(
            "actions.move_interval", lambda: INTERVALS[draws.integer(0, 3)], least=2
        )
        self.visit = values.integer(
            "actions.stop_time",
            lambda: draws.integer(2, 6) + self.turned("count"),
            least=1,
            most=self.passes,
        )
        angle = math.radians(values.number("actions.rotation_deg", lambda: draws.between(-30, 30)))
        self._reach = REACH * np.array([-math.sin(angle), math.cos(angle)])
        self.stopped_at: int | None = None
        self._place(0)

    def _place(self, k: int) -> None:
        """Put the cube where it is after `k` steps."""
        pass_index, steps = divmod(min(k, self.interval * self.passes), self.interval)
        if pass_index == self.passes:
            pass_index, steps = self.passes - 1, self.interval
        side = 2 * smoothstep(steps / self.interval) - 1
        if pass_index % 2 == 1:  # on the way back
            side = -side
        xy = self.target.position[:2] + self._reach * side
        self.cube.move_to(sapien.Pose([*xy, self.cube.position[2]]))

    def cues(self) -> list[Cue]:
        """The visits until the cube is to be stopped, that one included; a disc goes where the cube
        turns round.
        """

        def left() -> int:
            now = self.stopped_at
            if now is None:
                now = self.steps_done
            return self.visit - now // self.interval

        return tally(row(self.passes), left)

    def before_physics(self, k: int) -> None:
        if self.stopped_at is None and pressed(self.button):
            self.stopped_at = k

    def after_step(self, k: int) -> None:
        if self.stopped_at is None:
            self._place(k)

    @property
    def deadline(self) -> int:
        """The step at which the wanted visit's pass ends."""
        return self.interval * self.visit

    def _in_time(self) -> bool:
        if self.stopped_at is None:
            return False
        return self.deadline - self.interval <= self.stopped_at <= self.deadline

    def _on_target(self) -> bool:
        return distance_xy(self.cube.position, self.target.position) <= STOPPED_AT

    def failure(self) -> bool:
        if self.stopped_at is not None:
            return not (self._on_target() and self._in_time())
        return self.steps_done > self.deadline

    def visible_facts(self, ended: Mapping[int, SubTask]) -> dict[str, VisibleFact]:
        if self.stopped_at is not None or not self._on_target():
            return {}
        visit = self.steps_done // self.interval
        return {f"visit {visit}": VisibleFact(str(visit + 1), {"visits"}, replaces=True)}

    def checkpoints(self) -> list[int]:
        """Steps until which the arm waits: every 100th, then the one at which to press."""
        last = self.deadline - self.interval // 2 - LEAD
        return [*range(CHECKPOINT, last, CHECKPOINT), last]

    def subtasks(self) -> list[SubTask]:
        hover = SubTask(
            "move to the top of the button to prepare",
            done=lambda: hovering(self, self.button),
            run=lambda demo: demo.hover(self.button),
            grounded="move to the top of the button at <> to prepare",
            targets=[self.button],
            choice="a",
            operation=self._mistaken,
        )
        waits = [self._wait(until) for until in self.checkpoints()]
        press = SubTask(
            "press the button to stop the cube on the target",
            done=lambda: self._in_time() and self._on_target(),
            run=self._press,
            grounded="press the button to stop the cube on the target at <>",
            targets=[self.target],
            choice="c",
            operation=self._mistaken,
        )
        return [hover, *waits, press]

    def _mistaken(self) -> str:
        """On the right visit the cube was only missed; on another one the count was forgotten."""
        return "" if self._in_time() else "how many"

    def _press(self, demo: Demonstrator) -> None:
        """Press; if the wait before it ended so late that the cube would have passed, without
        closing the fingers.
        """
        crossing = self.deadline - self.interval // 2
        tolerated = self.interval // 15  # steps that the cube takes over half the target
        is_late = self.steps_done + PRESS_STEPS > crossing + tolerated
        demo.press(self.button, hold=False, close=not (self.second_tries and is_late))

    def _wait(self, until: int) -> SubTask:
        return SubTask(
            "remain static",
            done=lambda: self.steps_waited >= until,
            run=lambda demo: demo.hold_until(until),
            choice="b",
            operation=self._mistaken,
        )

    def _remain_static(self, demo: Demonstrator, _: None) -> None:
        """Wait until the next step of `checkpoints`."""
        now = self.steps_done
        demo.hold_until(next((k for k in self.checkpoints() if k > now), now))

    def choices(self) -> list[Choice]:
        return [
            Choice(
                "a",
                "move to the top of the button to prepare",
                lambda demo, _: demo.hover(self.button),
            ),
            Choice("b", "remain static", self._remain_static),
            Choice("c", "press button to stop the cube", lambda demo, _: self._press(demo)),
        ]

    def goals(self) -> list[str]:
        visit = ordinal(self.visit - 1)
        return [
            f"press the button to stop the cube just as it reaches the target for the {visit} time",
            f"press the button to stop the cube exactly at the target on its {visit} visit",
        ]
