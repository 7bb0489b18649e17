"""VideoPlaceButton (Reference): put the cube on the target it was on before, or after, the button
was pressed.
"""

from typing import ClassVar

from mme_vla.envs.robomme.scene.objects import Disc
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.video_place import VideoPlace
from mme_vla.envs.subtasks import SubTask


@register_task
class VideoPlaceButton(VideoPlace):
    """The video shows two placements, with a press of the button between them."""

    spot_radius = 0.06
    target_counts: ClassVar[dict[str, int]] = {"easy": 3, "medium": 4, "hard": 4}

    def draw_script(self, draws: Draws) -> None:
        values, count = self.values, len(self.targets)
        self.before = values.flag("objects.task_flag", draws.coin)
        self._extra = {
            when: self._indices(f"objects.extra_place_target_ids.{when}", count)
            for when in ("before", "after")
        }
        goal = values.find("actions.target_target_id")
        if goal is not None and goal != self.targets.index(self.goal_target):
            raise values.error(
                "actions.target_target_id", f"is {goal}; the other values give another target"
            )

    def _indices(self, name: str, count: int) -> list[int]:
        """Targets on which a row has the cube put beside the first two."""
        return [] if self.values.find(name) is None else self.values.indices(name, list, count)

    @property
    def goal_target(self) -> Disc:
        before = [0, *self._extra["before"]]
        return self.targets[before[-1] if self.before else 1]

    def visits(self) -> list[SubTask]:
        before = [0, *self._extra["before"]]
        after = [1, *self._extra["after"]]
        visible = [
            [step for i in part for step in (self.show_pick(), self.show_drop(self.targets[i]))]
            for part in (before, after)
        ]
        return [
            *visible[0],
            self.show_press(),
            *visible[1],
            *(self.put_back(self.cube) if self.tier else []),
        ]

    def goals(self) -> list[str]:
        place = f"place the {self.cube.colour} cube on the target"
        start = f"watch the video carefully, then {place}"
        when = "before" if self.before else "after"
        order = "last placed before" if self.before else "first placed after"
        if self.tier:
            return [f"{start} where it was {order} the button was pressed"]
        return [
            f"{start} right {when} the button was pressed",
            (
                f"watch the video carefully, and {place} where it was placed immediately {when} the"
                " button was pressed"
            ),
            f"{start} where it was previously placed {when} the button was pressed",
            f"{start} where it was {order} the button was pressed",
        ]
