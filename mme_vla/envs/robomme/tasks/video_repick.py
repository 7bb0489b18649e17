"""VideoRepick (Reference): the video picks up a cube; pick the same one up again, wherever it is
now.
"""

from collections.abc import Mapping
from typing import Any

from mme_vla.envs.facts import VisibleFact
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import (
    SWAP_STEPS,
    Cue,
    Swap,
    consecutive_swaps,
    row,
    tally,
    under,
)
from mme_vla.envs.robomme.scene.objects import COLOURS, RGB, Cube
from mme_vla.envs.robomme.scene.placement import ANCHOR_HALF, Draws, Region, rotated_anchors
from mme_vla.envs.robomme.scene.predicates import StaticFor, any_picked_up, pressed
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import (
    SAMPLED_COLOURS,
    VideoSwaps,
    add_button,
    add_cube,
    delay,
    end_video,
    go_home,
    pick,
    press,
    press_choice,
    put_down,
    put_down_choice,
    read_swaps,
    wait,
)
from mme_vla.envs.subtasks import Choice, SubTask, number, ordinal

SWAPS = {"easy": (1, 2), "medium": (2, 3), "hard": (0, 0)}
ROUNDS = 5  # of the three colours, in hard episodes
GO_HOME_STEPS = 20
VIDEO_RELEASE_Z, RELEASE_Z = 0.03, 0.01
TABLE = Region((-0.1, 0), (0.2, 0.25))
PRESS_PUNISHED = (50, 500)  # steps since the kind of stage was first entered


@register_task
class VideoRepick(VideoSwaps):
    """Three cubes of one colour that change places, or fifteen that do not."""

    shared_draws = True
    latch_failure = True
    recovery_sampled_per_episode = True
    fact_choices = "a"

    def plan(self, draws: Draws) -> None:
        self.repetitions = self.values.integer(
            "objects.num_repeats", lambda: draws.integer(1, 4) + self.turned("count"), least=1
        )
        low, high = SWAPS[self.difficulty]
        self.swap_count = draws.integer(low, high + 1)

    def build(self, draws: Draws) -> None:
        values = self.values
        self.button = add_button(self, draws, (-0.2, 0), (0.1, 0.1))
        self.cubes: list[Cube] = []
        target = 0
        initiators: list[int] = []
        if values.specified:
            self._read_cubes(draws)
        elif self.difficulty == "hard":
            target = self._draw_many_cubes(draws)
        else:
            target, initiators = self._draw_equal_cubes(draws)
        count = len(self.cubes)
        self.cube = self.cubes[values.integer("objects.target", lambda: target, most=count - 1)]
        self.wrong_cubes = [cube for cube in self.cubes if cube is not self.cube]
        self.swapped = read_swaps(self, self.cubes, lambda: initiators)
        self.swap_count = len(self.swapped)

    def _read_cubes(self, draws: Draws) -> None:
        """Add the row's cubes, all of one colour or each of its own."""
        values = self.values
        count = values.count("layout.cubes")
        values.require(count, "layout.cubes", "is missing or empty")
        one_colour = values.find("objects.color_rgb") is not None
        for i in range(count):
            colour: str | RGB
            if one_colour:
                colour = values.colour("objects.color_rgb", list)
            else:
                colour = values.word(f"objects.colors.{i}", str, COLOURS)
            self._add_cube(draws, colour, TABLE)

    def _draw_many_cubes(self, draws: Draws) -> int:
        """Add cubes of three colours anywhere; the index of the target."""
        for _ in range(ROUNDS):
            for i in draws.permutation(3):
                self._add_cube(draws, SAMPLED_COLOURS[i], TABLE)
        return draws.integer(0, len(self.cubes))

    def _draw_equal_cubes(self, draws: Draws) -> tuple[int, list[int]]:
        """Add three cubes of one colour; indices of the target and of those that begin a swap."""
        colour = SAMPLED_COLOURS[draws.integer(0, 3)]
        draws.permutation(4)  # part of the official stream, without effect
        for anchor in rotated_anchors(draws, 3):
            self._add_cube(draws, colour, Region(anchor, ANCHOR_HALF))
        target = draws.permutation(3)[0]
        initiators = [target]
        others = [i for i in range(len(self.cubes)) if i != target]
        for i in draws.permutation(2):
            initiators.append(others[i])
        return target, initiators[: self.swap_count]

    def _add_cube(self, draws: Draws, colour: str | RGB, region: Region) -> None:
        i, avoid = len(self.cubes), [self.button, *self.cubes]
        if not self.values.specified:
            self.values.note(f"objects.colors.{i}", colour)
        self.cubes.append(
            add_cube(self, draws, f"cube_{i}", colour, region, avoid, value=f"layout.cubes.{i}")
        )

    def start_episode(self, draws: Draws) -> None:
        super().start_episode(draws)
        self._entered: dict[str, int] = {}

    def make_swaps(self, start: int) -> list[Swap]:
        return consecutive_swaps(self.swapped, self.cubes, start)

    def flip_fact(self) -> dict[str, Any] | None:
        """The video picks up the next cube instead."""
        count = len(self.cubes)
        if count < 2:
            return None
        following = (self.cubes.index(self.cube) + 1) % count
        return self.values.changed({"objects.target": following})

    def cues(self) -> list[Cue]:
        def left() -> int:
            return sum(step.choice == "b" and not step.video for step in self.progress.to_come)

        return [under(self.cube), *tally(row(self.repetitions), left)]

    def visible_facts(self, ended: Mapping[int, SubTask]) -> dict[str, VisibleFact]:
        facts = super().visible_facts(ended)
        for i, subtask in ended.items():
            if subtask.choice == "b" and not subtask.video:  # one repetition is done
                facts[f"{i} {subtask.text}"] = self.count_fact(i)
        return facts

    def subtasks(self) -> list[SubTask]:
        swaps = [self._swap_wait(i) for i in range(self.swap_count)]
        self.swap_stage = swaps[0] if swaps else None
        steps = [
            pick(self, self.cube, "pick up the cube", grounded="", video=True),
            put_down(
                self, self.cube, "drop the cube on the table", "b", VIDEO_RELEASE_Z, video=True
            ),
        ]
        longer = delay(self)
        if swaps or longer:
            steps.append(go_home(self, GO_HOME_STEPS + longer))
        steps += [*swaps, end_video(self)]
        for i in range(self.repetitions):
            steps += self._repetition(i)
        stop = press(
            self.button,
            "press the button to finish",
            "c",
            failed=lambda: any_picked_up(self, self.cubes),
            operation="how many",
        )
        return [*steps, stop]

    def _swap_wait(self, i: int) -> SubTask:
        """Hold still for a swap; in RoboMME-OOD until it ends."""
        if not self.tier:
            return wait(self, SWAP_STEPS)
        still = StaticFor(self, 1)

        def run(demo: Demonstrator) -> None:
            if not self.swaps:
                demo.hold(SWAP_STEPS)
            while self.swaps and self.steps_done < self.swaps[i].end:
                demo.open()

        def done() -> bool:
            at_rest = still()  # asked at every step, as it must be
            return at_rest and bool(self.swaps) and self.steps_done >= self.swaps[i].end

        return SubTask("static", done, run, video=True)

    def _repetition(self, i: int) -> list[SubTask]:
        return [
            pick(
                self,
                self.cube,
                f"pick up the correct cube for the {ordinal(i)} time",
                failed=lambda: self._strayed("pick", i),
                pick=True,
                operation=self._mistaken,
            ),
            put_down(
                self,
                self.cube,
                "put it down",
                "b",
                RELEASE_Z,
                failed=lambda: self._strayed("put", i),
                operation=self._mistaken,
            ),
        ]

    def _strayed(self, kind: str, i: int) -> bool:
        """Whether another cube is up, or the button is down in the window of a stage.

        In RoboMME-OOD each round has a window of its own.
        """
        if any_picked_up(self, self.wrong_cubes):
            return True
        first, last = PRESS_PUNISHED
        if self.tier and i:
            kind, first = f"{kind} {i}", 0
        entered = self._entered.setdefault(kind, self.steps_done)
        return first <= self.steps_done - entered <= last and pressed(self.button)

    def _mistaken(self) -> str:
        return "which" if any_picked_up(self, self.wrong_cubes) else "how many"

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", Demonstrator.pick, self.cubes),
            put_down_choice("b", "put it down", RELEASE_Z),
            press_choice("c", "press the button to finish", self.button),
        ]

    def goals(self) -> list[str]:
        watch = "watch the video carefully"
        same_cube = "pick up the same cube that was previously picked up"
        same_block = "the same block that was previously picked up"
        if self.repetitions == 1:
            return [
                (
                    f"{watch}, then pick up {same_block} again, finally put it down and press the"
                    " button to stop"
                ),
                f"{watch}, then {same_cube} again, finally press the button to stop",
            ]
        times = f"{number(self.repetitions)} times"
        short = "twice" if self.repetitions == 2 else times
        return [
            (
                f"{watch}, then repeatedly pick up and put down {same_block} for {times}, finally"
                " put it down and press the button to stop"
            ),
            f"{watch}, then {same_cube} {short}, and finally press the button to stop",
            (
                f"{watch}, identify the cube that was picked up, then pick up and place down the"
                f" same cube {short}, finally press the button to stop"
            ),
        ]
