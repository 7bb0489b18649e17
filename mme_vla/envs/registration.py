"""The entry point of Gymnasium's plugins: `gymnasium.make("mme_vla/StopCube-v0")` needs no import of this library."""

from mme_vla.envs.metadata import TASK_NAMES


def register_tasks() -> None:
    """Register the sixteen tasks with Gymnasium; a second call does nothing."""
    from gymnasium.envs.registration import register, registry

    for task in TASK_NAMES:
        if (name := f"mme_vla/{task}-v0") not in registry:
            register(id=name, entry_point="mme_vla.envs.gym:GymTask", kwargs={"task": task})
