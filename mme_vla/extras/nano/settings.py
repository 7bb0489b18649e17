"""What a run of nanoMME may be told (`configs/nano.yaml`), checked before anything starts."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self, get_args

from mme_vla.config.sections import NonNegativeInt, PathText, PositiveInt, read_section
from mme_vla.envs.episodes import choose_episodes
from mme_vla.errors import require

Stage = Literal["record", "tokens", "train", "evaluate", "all"]
STAGES: tuple[Stage, ...] = get_args(Stage)
"""In the order in which they run."""


@dataclass(frozen=True)
class LearningSettings:
    """The section `learning`: which decisions are learned more often, and how they are changed."""

    often: PositiveInt = 1
    noise: float = 0.0
    elsewhere: float = 0.0
    history_transforms: Any = None
    blur: float = 0.0
    reflect: float = 0.0
    balanced: bool = False
    sides: tuple[str, ...] = ()


@dataclass(frozen=True)
class NanoRun:
    """A run as a command line describes it, read once; the keys are explained in the file.

    train, learning: plain, as checkpoints keep them.
    config: all of it as plain values.
    """

    task: Any
    stage: Stage
    with_memory: str | tuple[str, ...]
    budget: int | tuple[int, ...] | None
    trainings: PositiveInt
    beside: tuple[str, ...]
    also: tuple[str, ...]
    also_episodes: Any
    also_trainings: PositiveInt
    planner: bool
    oracle: str | None
    floors: bool
    rendered_for: tuple[str, ...]
    demonstrations: Mapping[str, Any]
    demonstrations_of: Mapping[str, Mapping[str, Any]] | None
    carried_out: bool
    videos: bool
    first_seed: int
    split: str
    episodes: Any
    replace: bool
    policy_seed: int
    max_steps: NonNegativeInt
    max_choices: PositiveInt | None
    only_possible: bool
    workers: PositiveInt
    shard: Any
    with_backbone: str
    with_embodiment: str
    overrides: tuple[str, ...]
    train: Mapping[str, Any]
    learning: Mapping[str, Any]
    memories: Mapping[str, Mapping[str, Any]]
    plugins: Any
    seed: int
    output: PathText
    config: Mapping[str, Any]

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration, plain and resolved."""
        run = read_section(cls, config, others=True, config={})
        read_section(LearningSettings, run.learning, "learning")
        # Episodes are chosen after hours of recording and training: make sure now that they exist.
        amounts = [run.episodes]
        if run.also and run.also_episodes is not None:
            amounts.append(run.also_episodes)
        for episodes in amounts:
            require(
                isinstance(episodes, int) or not run.replace,
                f"episodes={episodes}: with replace=true write how many scenes of each task.",
            )
            choose_episodes(run.task, episodes, run.split)
        return replace(run, config=config)

    @property
    def budgets(self) -> tuple[int | None, ...]:
        """The budgets of memories; None: each memory's own."""
        return self.budget if isinstance(self.budget, tuple) else (self.budget,)

    @property
    def models(self) -> list[str]:
        """The models of the rows, each once."""
        first = self.with_memory if isinstance(self.with_memory, tuple) else (self.with_memory,)
        return list(dict.fromkeys([*first, *self.beside, *self.also]))

    def is_further(self, row: str) -> bool:
        """Whether a row is one of `also`, which have fewer trainings and episodes."""
        return row.partition("@")[0] in self.also
