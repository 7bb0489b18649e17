"""RoboMME as the entry `mme_vla` of the registry of environments."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from typing import Any

from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import check_benchmark
from mme_vla.envs import make, metadata
from mme_vla.envs.base import Environment
from mme_vla.envs.facts import Fact
from mme_vla.envs.metadata import TASK_NAMES, EpisodeSpec
from mme_vla.envs.scene_hash import NOT_BUILT, scene_digest
from mme_vla.errors import SceneError
from mme_vla.registry import ENVS


@ENVS.register("mme_vla")
class RoboMME(Environment):
    """The sixteen tasks on stock ManiSkill, and tasks of the user's own; `mme-vla record`
    demonstrates them.
    """

    tasks = TASK_NAMES

    def check_task(self, task: str) -> None:
        """A task of the benchmark, or a registered one."""
        metadata.check_task_name(task)

    def check_split(self, split: str) -> None:
        """A split of the benchmark, or a variant."""
        metadata.check_split(split)

    def step_limit(self, split: str) -> int:
        """As many as the benchmark allows."""
        return metadata.step_limit(split)

    def check_installed(self) -> None:
        make.require_simulator()

    def check_embodiment(self, robot: Embodiment) -> None:
        """A robot with one of the benchmark's action spaces and its cameras."""
        check_benchmark(robot, make.ACTION_SPACES)

    def episodes(self, task: str, split: str) -> list[EpisodeSpec]:
        return metadata.episodes(task, split)

    def make(self, spec: EpisodeSpec, render: bool = True) -> Any:
        """The episode in joint angles."""
        return make.make_env(spec.task, spec.split, spec.episode, render=render)

    def check_hold(self) -> None:
        """Every episode takes a `Hold`."""

    def scene_values(self, env: Any) -> Mapping[str, Any] | None:
        """What was sampled, and where everything stands; only right after the reset of its task."""
        values: Mapping[str, Any] = env.task.placed_values()
        return values

    def facts(self, env: Any) -> Sequence[Fact]:
        """What the task's script shows and the simulator knows."""
        facts: Sequence[Fact] = env.facts
        return facts

    def twin(self, spec: EpisodeSpec) -> Mapping[str, Any] | None:
        """The row of the scene in which the task's `flip_fact` changed one fact.

        Raises:
            SceneError: there is no scene of `spec`.
        """
        with _scene_of(spec) as task:
            values = task.flip_fact()
            if values is None:
                return None
            row: dict[str, Any] = task.scene_values()
            return row | {"spec": values}

    def scene_digest(self, spec: EpisodeSpec) -> str:
        """Without the conditioning video, which does not belong to the scene."""
        try:
            with _scene_of(spec) as task:
                return scene_digest(task.placed_values())
        except SceneError:
            return NOT_BUILT

    def open(
        self,
        task: str,
        split: str,
        episode: int,
        *,
        action_space: str | None = None,
        max_steps: int | None = None,
        render: bool = True,
        row: Mapping[str, Any] | None = None,
    ) -> Any:
        action_space = action_space or make.ACTION_SPACES[0]
        return make.make_env(
            task, split, episode, action_space, max_steps=max_steps, render=render, row=row
        )


@contextmanager
def _scene_of(spec: EpisodeSpec) -> Iterator[Any]:
    """The task of an episode right after its reset, without images.

    Raises:
        SceneError: it cannot be built.
    """
    with closing(make.make_task(spec.task, render=False, **spec.options)) as task:
        task.reset()
        yield task
