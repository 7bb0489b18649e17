"""The script every task is made from: the order of a step, success and failure, on the stage of
`scene/stage.py`.

A task says which objects there are (`plan`, `build`, `start_episode`), what happens to them
(`before_physics`, `after_step`), and what is to be done (`subtasks`, `goals`, `choices`).
Everything else is here.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from numbers import Integral
from typing import Any, ClassVar

import sapien
import torch

from mme_vla.envs.facts import Candidates, VisibleFact
from mme_vla.envs.metadata import dials_of
from mme_vla.envs.robomme.scene.motions import CUE_COLOURS, CUE_HALF_LENGTH, Cue, Motion
from mme_vla.envs.robomme.scene.objects import BELOW_TABLE, Disc, build_highlight
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.scene.stage import Stage
from mme_vla.envs.robomme.scene.things import Thing
from mme_vla.envs.robomme.scene.values import Values
from mme_vla.envs.rows import DIFFICULTIES
from mme_vla.envs.subtasks import Choice, Progress, SubTask
from mme_vla.errors import check_known, require

RECOVERY_MODES = ("z", "xy")
_SEEDS = 2**63  # of a generator of random numbers


def candidates_among(things: Sequence[Thing], correct: Sequence[Thing]) -> Candidates:
    """Things as candidates, those that are also in `correct` as the correct ones."""
    numbers = set(map(id, correct))
    places, indices = [], []
    for i, thing in enumerate(things):
        places.append(thing.position[:2].tolist())
        if id(thing) in numbers:
            indices.append(i)
    return Candidates(places, indices)


class Task(Stage):
    """One RoboMME task as a ManiSkill environment (paper, appendix on tasks).

    Args:
        seed: fixes the scene and the script; the `seed` of `reset` has no effect.
        difficulty: `easy`, `medium` or `hard`; by default seed % 3 decides.
        recovery: `z` or `xy` samples the pick that a recovery demonstration fails once.
        stress: how far dials are turned (`metadata.DIALS`); at 0 the scene is the benchmark's.
        in_view: the fact that is to be remembered stays in view, as `split=twin` has it.
        row: the scene's values (`mme_vla.envs.rows`); nothing is sampled then, and its `tier`, if
            it has one, brings the rules of RoboMME-OOD.
        second_tries: the demonstrator continues where the benchmark's own gives up; without it, it
            fails where that does.
        robomme_failure_recovery, robomme_failure_recovery_mode: the benchmark's names for
            `recovery`.
    """

    shared_draws: ClassVar[bool] = False
    """`plan`, `build` and `start_episode` sample from one generator; otherwise `plan` has one of
    its own.
    """
    latch_failure: ClassVar[bool] = False
    """A failure lasts; otherwise it is evaluated anew at each step."""
    recovery_sampled_per_episode: ClassVar[bool] = False
    """The failed pick is sampled in every initialisation (there are two), not once
    after the scene.
    """
    fact_choices: ClassVar[str | None] = None
    """Letters of the options whose ends show what is to be remembered; None: all of them."""

    def __init__(
        self,
        *args: Any,
        seed: int = 0,
        difficulty: str | None = None,
        recovery: str | None = None,
        robomme_failure_recovery: bool = False,
        robomme_failure_recovery_mode: str | None = None,
        stress: Mapping[str, int] | None = None,
        in_view: bool = False,
        row: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        require(
            isinstance(seed, Integral) and 0 <= seed < _SEEDS,
            f"seed is {seed!r}; expected a non-negative integer below 2^63.",
        )
        if robomme_failure_recovery:
            recovery = robomme_failure_recovery_mode or recovery
            require(
                recovery is not None,
                "robomme_failure_recovery needs a robomme_failure_recovery_mode of"
                f" {RECOVERY_MODES}.",
            )
        if difficulty is not None:
            check_known("difficulty", difficulty, DIFFICULTIES)
        if recovery is not None:
            check_known("recovery mode", recovery, RECOVERY_MODES)
        self.stress: dict[str, int] = {}
        """Dials that are turned, and how far."""
        dials = dials_of(type(self).__name__)
        for dial, turned in (stress or {}).items():
            require(
                dial in dials and turned >= 0,
                f"{type(self).__name__} cannot turn {dial!r} by {turned}: its dials are"
                f" {', '.join(dials) or 'none'}, and turn up only.",
            )
            if turned:
                self.stress[dial] = turned
        self.where = f"{type(self).__name__}, seed {seed}"
        """What errors call the scene."""
        self.in_view = in_view
        self.row = row
        """The scene's values, where it is not sampled from its seed."""
        self.tier = (row or {}).get("tier") or ""
        self.difficulty = difficulty or DIFFICULTIES[seed % 3]
        self.recovery = recovery
        self.on_frame: Callable[[dict[str, Any]], None] | None = None
        """Called once a step with the info of the evaluation, after the physics and before
        `after_step`. While it is set, the simulator makes no observation of its own.
        """
        self.failed_pick: int | None = None
        """Index, among the picks of the execution, of the one that a recovery demonstration fails
        first.
        """
        super().__init__(*args, seed=int(seed), **kwargs)

    def turned(self, dial: str) -> int:
        """How far a dial is turned; 0 as in the benchmark."""
        return self.stress.get(dial, 0)

    # What a task supplies -------------------------------------------------------------------------

    def plan(self, draws: Draws) -> None:
        """Sample what is decided before there is a scene."""

    def build(self, draws: Draws) -> None:
        """Sample the layout and put the objects on the table; each goes through `self.add`."""
        raise NotImplementedError

    def start_episode(self, draws: Draws) -> None:
        """Sample what is decided per episode and set the script's state; objects are already in
        their places.
        """

    def subtasks(self) -> list[SubTask]:
        """The sub-tasks in order."""
        raise NotImplementedError

    def goals(self) -> list[str]:
        """Equivalent wordings of the goal, the one used for evaluation first."""
        raise NotImplementedError

    def choices(self) -> list[Choice]:
        """The options of the multi-choice action space."""
        raise NotImplementedError

    def before_physics(self, k: int) -> None:
        """Scripted changes before the physics of a step, by default the `motions`; `k` steps have
        been done.
        """
        for motion in self.motions:
            motion.apply(k)

    def after_step(self, k: int) -> None:
        """Scripted changes after a step's physics, evaluation and observation; `k` steps have been
        done.
        """

    def cues(self) -> Sequence[Cue]:
        """With `in_view`: the discs that show what is to be remembered; built with the scene, moved
        at each step.
        """
        return ()

    def visible_facts(self, ended: Mapping[int, SubTask]) -> dict[str, VisibleFact]:
        """The facts that the current frame shows and that the episode needs later, by their names.

        By default the key poses: the end of each sub-task of the video that a policy could choose
        (`fact_choices`), or, in a task without a video, of the execution, which are counted.

        Args:
            ended: the sub-tasks that have ended in the last frames, by their number.
        """
        has_video = any(subtask.video for subtask in self.progress.subtasks)
        facts = {}
        for i, subtask in ended.items():
            counts = self.fact_choices is None or subtask.choice in self.fact_choices
            if not subtask.choice or subtask.video != has_video or not counts:
                continue
            name = f"{i} {subtask.text}"
            if not has_video:
                facts[name] = self.count_fact(i)
                continue
            # What its end shows: its text, and the objects that it is about.
            things = [thing.name for thing in subtask.targets]
            value = subtask.text
            if things:
                value += f": {', '.join(things)}"
            facts[name] = VisibleFact(value, frozenset(things))
        return facts

    def count_fact(self, i: int) -> VisibleFact:
        """How many sub-tasks with the choice of sub-task `i` are done at its end."""
        subtasks = self.progress.subtasks[: i + 1]
        kind = (subtasks[i].choice, subtasks[i].video)
        count = sum((subtask.choice, subtask.video) == kind for subtask in subtasks)
        return VisibleFact(str(count), {f"count of {subtasks[i].choice}"}, replaces=True)

    def flip_fact(self) -> dict[str, Any] | None:
        """The values (`values.changed`) of a scene that differs from this one in a single fact: the
        goal, every place and what is to be done look the same once the fact has been shown.

        By default None: what the robot itself did, such as a count, is no value of a scene.
        """
        return None

    def candidates(self) -> Candidates | None:
        """X and y of what the current sub-task can be carried out on, where a decision of the
        execution depends on memory; None elsewhere.

        By default the objects that the sub-task's option chooses among.
        """
        subtask = self.progress.current
        if subtask is None or subtask.video or not subtask.operation:
            return None
        for choice in self.choices():
            if choice.label == subtask.choice and choice.candidates is not None:
                return candidates_among(choice.candidates, subtask.targets)
        return None

    def failure(self) -> bool:
        """What counts as failure at any time, whatever the sub-task."""
        return False

    def success(self) -> bool:
        """What counts as success: by default that every sub-task is done."""
        return self.progress.succeeded

    # The scene ------------------------------------------------------------------------------------

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        row = self.row or {}
        self.values = Values(row.get("spec"), str(row.get("where", self.where)))
        self.draws = Draws(self.seed)
        self.plan(self.draws)
        if not self.shared_draws:
            self.draws = Draws(self.seed)
        self.build(self.draws)
        self._draws_state = self.draws.state()
        self._cues: list[tuple[Disc, Cue]] = []
        if self.in_view:
            for i, cue in enumerate(self.cues()):
                colour = CUE_COLOURS[cue.colour]
                disc = build_highlight(self, f"cue_{i}", cue.radius, CUE_HALF_LENGTH, colour)
                self._cues.append((disc, cue))

    def _initialize_episode(self, env_idx: torch.Tensor, options: dict) -> None:
        super()._initialize_episode(env_idx, options)
        self.draws.restore(self._draws_state)
        # The official construction initialises an episode twice, and the samples of the second one
        # count.
        for attempt in range(2):
            for thing in self.things:
                thing.restore()
            self.motions: list[Motion] = []
            """Set by the task: what is moved before the physics of every step."""
            self.start_episode(self.draws)
            subtasks = self.subtasks()
            if self.recovery and (attempt == 0 or self.recovery_sampled_per_episode):
                self.failed_pick = None
                picks = sum(subtask.pick and not subtask.video for subtask in subtasks)
                if picks:
                    self.failed_pick = self.values.integer(
                        "actions.failed_pick",
                        partial(self.draw_failed_pick, self.draws, picks),
                        most=picks - 1,
                    )
        self.progress = Progress(subtasks, self.latch_failure)
        self._show_cues()

    def scene_values(self) -> dict[str, Any]:
        """The row of this scene: `make_env` builds the same scene from it, to the last bit."""
        row = {"task": type(self).__name__, "seed": self.seed, "difficulty": self.difficulty}
        for name in ("recovery", "tier", "in_view"):
            if getattr(self, name):
                row[name] = getattr(self, name)
        return row | {"spec": deepcopy(self.values.spec)}

    def placed_values(self) -> dict[str, Any]:
        """What was sampled, and position and quaternion [7] of every object; right after the reset,
        before any step.

        The discs of `in_view` do not count: the twin of a scene is the same scene.
        """
        poses = {}
        for thing in self.things:
            poses[thing.name] = [*thing.pose.p.tolist(), *thing.pose.q.tolist()]
        return {"spec": deepcopy(self.values.spec), "poses": poses}

    def draw_failed_pick(self, draws: Draws, picks: int) -> int:
        """Which of the execution's `picks` a recovery demonstration fails first."""
        return draws.integer(0, picks)

    # A step ---------------------------------------------------------------------------------------

    def step(self, action: Any) -> tuple:
        result = super().step(action)
        self.after_step(self.steps_done)
        return result

    def get_obs(self, info: dict | None = None, unflattened: bool = False) -> Any:
        if self.on_frame is None or info is None:
            return super().get_obs(info, unflattened)
        self.on_frame(info)
        return {}

    def simulator_obs(self, info: dict[str, Any]) -> Any:
        """The present observation in ManiSkill's own format."""
        return super().get_obs(info)

    def _before_control_step(self) -> None:
        self.before_physics(self.steps_done)
        self._show_cues()

    def _show_cues(self) -> None:
        for disc, cue in self._cues:
            place = cue.place()
            disc.move_to(sapien.Pose(BELOW_TABLE if place is None else place, disc.pose.q))

    def evaluate_planned(self) -> None:
        """Evaluate once before or after a sub-task's routine, where the demonstrator's pointer
        moves.
        """
        self.evaluate()
        self.progress.planned = self.progress.index

    def evaluate(self) -> dict[str, torch.Tensor]:
        """Move the pointer over the sub-tasks; success and failure, each bool [1]."""
        self.progress.update(self.failure())
        return {
            "success": torch.tensor([self.success() and not self.progress.failed]),
            "fail": torch.tensor([self.progress.failed]),
        }
