"""The sixteen tasks, one file each; importing a task registers it."""

import gymnasium
from mani_skill.utils.registration import register_env

from mme_vla.envs.task import Task
from mme_vla.registry import TASKS


def register_task[T: type[Task]](task: T) -> T:
    """File a task under its class name, in `TASKS` and as a Gymnasium id."""
    TASKS.register(task.__name__)(task)
    # The official package uses the same ids; the first import keeps them.
    if task.__name__ not in gymnasium.registry:
        register_env(task.__name__)(task)
    return task
