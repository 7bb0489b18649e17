"""`BenchmarkEnvBuilder`: the episodes of one task, under the official class's names."""

from dataclasses import fields
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, Field

from mme_vla.envs import metadata
from mme_vla.envs.interface import RoboMMEEnv
from mme_vla.envs.make import check_names, make_env
from mme_vla.envs.metadata import TASK_NAMES, EpisodeSpec
from mme_vla.envs.observations import Include
from mme_vla.errors import UserError, check_known, require
from mme_vla.utils import read_json
from mme_vla.utils.validation import validated

__all__ = ["BenchmarkEnvBuilder"]

_Number = Annotated[int, Field(strict=True, ge=0, lt=2**31)]


class _Episode(BaseModel):
    """What is read of an episode in an official metadata file."""

    episode: _Number
    seed: _Number
    difficulty: Literal["easy", "medium", "hard"]


class _File(BaseModel):
    """What is read of an official metadata file."""

    records: Annotated[list[_Episode], Field(min_length=1)]


def read_episodes(path: Path, task: str, split: str) -> list[EpisodeSpec]:
    """The episodes that an official metadata file describes, in order."""
    content = read_json(path, f"official metadata of {task}, split {split!r}")
    try:
        records = validated(_File, content, "The file").records
    except UserError as error:
        raise UserError(f"{path} is not official metadata: {error} Get the file again.") from None
    specs = []
    for record in records:
        specs.append(EpisodeSpec(task, split, record.episode, record.seed, record.difficulty))
    specs.sort(key=lambda spec: spec.episode)
    is_complete = [spec.episode for spec in specs] == list(range(len(specs)))
    require(is_complete, f"{path} does not number its episodes 0, 1, 2, …; get the file again.")
    return specs


class BenchmarkEnvBuilder:
    """Makes the environments of a task's episodes.

    Args:
        env_id: one of the 16 task names.
        dataset: `train`, `val` or `test`.
        action_space: `joint_angle`, `ee_pose`, `waypoint` or `multi_choice`.
        gui_render: a window; there is none here.
        override_metadata_path: a folder of `record_dataset_<Task>_metadata.json`, in place of the
            benchmark's episodes.
        max_steps: control steps until the status becomes `timeout`.

    Raises:
        UserError: an unknown name, a window, or metadata that cannot be read.
    """

    def __init__(
        self,
        env_id: str,
        dataset: str = "test",
        action_space: str = "joint_angle",
        gui_render: bool = False,
        override_metadata_path: str | Path | None = None,
        max_steps: int = 10000,
    ) -> None:
        if gui_render:
            raise UserError(
                "gui_render=True: these environments open no window. Leave it out, and use"
                " render()."
            )
        check_names(env_id, action_space)
        self.env_id, self.dataset, self.action_space, self.max_steps = (
            env_id,
            dataset,
            action_space,
            max_steps,
        )
        if override_metadata_path is None:
            self._episodes = metadata.episodes(env_id, dataset)
        else:
            file = Path(override_metadata_path) / f"record_dataset_{env_id}_metadata.json"
            self._episodes = read_episodes(file, env_id, dataset)

    @classmethod
    def get_task_list(cls) -> list[str]:
        """The sixteen tasks, in the benchmark's order."""
        return list(TASK_NAMES)

    def get_episode_num(self) -> int:
        """How many episodes the task has."""
        return len(self._episodes)

    def resolve_episode(self, episode: int) -> tuple[int, str]:
        """Seed and difficulty of an episode.

        Raises:
            UserError: there is no such episode.
        """
        if not 0 <= episode < len(self._episodes):
            raise UserError(
                f"{self.env_id} has the episodes 0 to {len(self._episodes) - 1}, and no {episode}."
            )
        spec = self._episodes[episode]
        return spec.seed, spec.difficulty

    def make_env_for_episode(
        self, episode_idx: int, max_steps: int | None = None, **include: bool
    ) -> RoboMMEEnv:
        """Make an episode's environment; call `reset()` first.

        Args:
            max_steps: by default the builder's. include: `include_front_depth` and the like, the
                fields of `mme_vla.envs.observations.Include`.

        Raises:
            UserError: no such episode, an unknown option, a missing package, or no Vulkan driver.
        """
        seed, difficulty = self.resolve_episode(episode_idx)
        known = {f"include_{field.name}": field.name for field in fields(Include)}
        for name in include:
            check_known("option", name, known)
        env = make_env(
            self.env_id, action_space=self.action_space, seed=seed, difficulty=difficulty,
            max_steps=self.max_steps if max_steps is None else max_steps,
            include=Include(**{known[name]: value for name, value in include.items()}),
        )  # fmt: skip
        assert isinstance(env, RoboMMEEnv)
        return env
