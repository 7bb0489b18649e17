"""VideoPlaceButton (Reference): put the cube on the target it was on before, or after, the button
was pressed.
"""

from typing import Any, ClassVar

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
        values = self.values
        self.before = values.flag("objects.task_flag", draws.coin)
        # A row may have the cube put on further targets beside the first two.
        self._visited_before = [0, *self._further_visits("before")]
        self._visited_after = [1, *self._further_visits("after")]
        goal = values.find("actions.target_target_id")
        values.require(
            goal in (None, self.targets.index(self.goal_target)),
            "actions.target_target_id",
            f"is {goal}; the other values give another target",
        )

    def _further_visits(self, when: str) -> list[int]:
        name = f"objects.extra_place_target_ids.{when}"
        if self.values.find(name) is None:
            return []
        return self.values.indices(name, list, len(self.targets))

    @property
    def goal_target(self) -> Disc:
        if self.before:
            return self.targets[self._visited_before[-1]]
        return self.targets[self._visited_after[0]]

    def flip_fact(self) -> dict[str, Any]:
        """The two visited targets change places, and with them the order of the visits.

        Where two targets change places later, it is the same two places.
        """
        first, second, *others = self.values.find("layout.targets")
        other = {0: 1, 1: 0}
        swapped = self.values.find("objects.swap_pair_ids") or []
        return self.values.changed(
            {
                "layout.targets": [second, first, *others],
                "objects.swap_pair_ids": [other.get(i, i) for i in swapped],
            }
        )

    def visits(self) -> list[SubTask]:
        steps: list[SubTask] = []
        for i in self._visited_before:
            steps += [self.show_pick(self.cube), self.show_drop(self.cube, self.targets[i])]
        steps.append(self.show_press())
        for i in self._visited_after:
            steps += [self.show_pick(self.cube), self.show_drop(self.cube, self.targets[i])]
        if self.tier:
            steps += self.put_back(self.cube)
        return steps

    def goals(self) -> list[str]:
        place = f"place the {self.cube.colour} cube on the target"
        start = f"watch the video carefully, then {place}"
        when, order = "after", "first placed after"
        if self.before:
            when, order = "before", "last placed before"
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
