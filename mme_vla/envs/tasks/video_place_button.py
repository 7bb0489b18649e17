"""VideoPlaceButton (Reference): put the cube on the target it was on before, or after, the button was pressed."""

from typing import ClassVar

from mme_vla.envs.scene.objects import Disc
from mme_vla.envs.scene.placement import Draws
from mme_vla.envs.subtasks import SubTask
from mme_vla.envs.tasks import register_task
from mme_vla.envs.tasks.families.video_place import VideoPlace


@register_task
class VideoPlaceButton(VideoPlace):
    """The video shows two placements, with a press of the button between them."""

    spot_radius = 0.06
    target_counts: ClassVar[dict[str, int]] = {"easy": 3, "medium": 4, "hard": 4}

    def draw_script(self, draws: Draws) -> None:
        self.before = draws.coin()

    @property
    def goal_target(self) -> Disc:
        return self.targets[0 if self.before else 1]

    def visits(self) -> list[SubTask]:
        first, second = self.targets[:2]
        return [
            self.show_pick(), self.show_drop(first), self.show_press(), self.show_pick(), self.show_drop(second)
        ]  # fmt: skip

    def goals(self) -> list[str]:
        start = f"watch the video carefully, then place the {self.cube.colour} cube on the target"
        when = "before" if self.before else "after"
        order = "last placed before" if self.before else "first placed after"
        return [
            f"{start} right {when} the button was pressed",
            f"{start} immediately {when} the button was pressed",
            f"{start} where it was previously placed {when} the button was pressed",
            f"{start} where it was {order} the button was pressed",
        ]
