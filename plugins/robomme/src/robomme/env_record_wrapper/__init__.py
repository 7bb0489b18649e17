"""`BenchmarkEnvBuilder`: the episodes of one task, under the official class's names."""

from dataclasses import fields
from pathlib import Path

from mme_vla.envs import metadata
from mme_vla.envs.interface import RoboMMEEnv
from mme_vla.envs.make import check_names, make_env
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.envs.observations import Include
from mme_vla.errors import UserError, check_known

__all__ = ["BenchmarkEnvBuilder"]


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
        check_names(env_id, action_space, None, None)
        self.env_id, self.dataset, self.action_space, self.max_steps = (
            env_id,
            dataset,
            action_space,
            max_steps,
        )
        if override_metadata_path is None:
            self._episodes = metadata.episodes(env_id, dataset)
        else:
            file = Path(override_metadata_path) / metadata.file_name(env_id)
            self._episodes = metadata.read_official(file, env_id, dataset)

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
