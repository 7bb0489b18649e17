"""VideoPlaceOrder (Reference): put the cube on the first, second, … target it was placed on in the
video.
"""

from copy import deepcopy
from typing import Any, ClassVar

from mme_vla.envs.robomme.scene.objects import Cube, Disc
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.video_place import VideoPlace
from mme_vla.envs.subtasks import SubTask, ordinal


@register_task
class VideoPlaceOrder(VideoPlace):
    """The video visits some of the targets in random order; a press of the button
    comes in between.
    """

    shared_draws = True
    recovery_sampled_per_episode = True
    spot_radius = 0.1
    operation = "order"
    target_counts: ClassVar[dict[str, int]] = {"easy": 4, "medium": 4, "hard": 4}

    def draw_script(self, draws: Draws) -> None:
        values, targets = self.values, self.targets

        def sample() -> list[int]:
            count = draws.integer(2, 5)
            return draws.permutation(4)[:count]

        name = "objects.visit_ids_by_object"
        rows = max(values.count(name), 1)
        cubes = len(self.demonstrated)
        values.require(rows == cubes, name, f"has {rows} lists for {cubes} cubes")
        self._visits: list[tuple[Cube, list[Disc]]] = []
        total = 0
        for i, cube in enumerate(self.demonstrated):
            ids = values.indices(f"{name}.{i}", sample, len(targets))
            self._visits.append((self.cubes[cube], [targets[j] for j in ids]))
            total += len(ids)
        requested = values.integer("objects.answer_demo_index", lambda: 0, most=rows - 1)
        self.cube, self.visited = self._visits[requested]
        count = len(self.visited)
        self.rank = values.integer(
            "objects.which_in_subset", lambda: draws.integer(1, count + 1), least=1, most=count
        )
        self.press_after = values.integer(
            "objects.button_after_visit_index", lambda: draws.integer(0, count), most=total - 1
        )

    @property
    def goal_target(self) -> Disc:
        return self.visited[self.rank - 1]

    def flip_fact(self) -> dict[str, Any] | None:
        """The target that counts is visited when the next one was, and that one in its place."""
        count = len(self.visited)
        if count < 2:
            return None
        name = "objects.visit_ids_by_object"
        visits = deepcopy(self.values.find(name))
        for cube, targets in zip(self.demonstrated, visits, strict=True):
            if self.cubes[cube] is self.cube:
                first = self.rank - 1
                second = self.rank % count
                targets[first], targets[second] = targets[second], targets[first]
        return self.values.changed({name: visits})

    def visits(self) -> list[SubTask]:
        steps: list[SubTask] = []
        done = 0
        for cube, targets in self._visits:
            for target in targets:
                steps += [self.show_pick(cube), self.show_drop(cube, target)]
                if done == self.press_after:
                    steps.append(self.show_press())
                done += 1
            if self.tier:
                steps += self.put_back(cube)
        return steps

    def goals(self) -> list[str]:
        place = f"place the {self.cube.colour} cube on the {ordinal(self.rank - 1)} target"
        return [
            f"watch the video carefully, then {place} it was previously placed on",
            f"watch the video carefully and {place} where it was placed",
        ]
