"""VideoPlaceOrder (Reference): put the cube on the first, second, … target it was placed on in the video."""

from typing import ClassVar

from mme_vla.envs.scene.objects import Disc
from mme_vla.envs.scene.placement import Draws
from mme_vla.envs.subtasks import SubTask, ordinal
from mme_vla.envs.tasks import register_task
from mme_vla.envs.tasks.families.video_place import VideoPlace


@register_task
class VideoPlaceOrder(VideoPlace):
    """The video visits some of the targets in random order; a press of the button comes in between."""

    shared_draws = True
    recovery_sampled_per_episode = True
    spot_radius = 0.1
    operation = "order"
    target_counts: ClassVar[dict[str, int]] = {"easy": 4, "medium": 4, "hard": 4}

    def draw_script(self, draws: Draws) -> None:
        count = draws.integer(2, 5)
        self.visited = [self.targets[i] for i in draws.permutation(4)[:count]]
        self.rank = draws.integer(1, count + 1)
        self.press_after = draws.integer(0, count)

    @property
    def goal_target(self) -> Disc:
        return self.visited[self.rank - 1]

    def visits(self) -> list[SubTask]:
        steps = []
        for i, target in enumerate(self.visited):
            steps += [self.show_pick(), self.show_drop(target)]
            if i == self.press_after:
                steps.append(self.show_press())
        return steps

    def goals(self) -> list[str]:
        cube, which = f"place the {self.cube.colour} cube on the", f"{ordinal(self.rank - 1)} target"
        return [
            f"watch the video carefully, then {cube} {which} it was previously placed on",
            f"watch the video carefully and {cube} {which} where it was placed",
        ]
