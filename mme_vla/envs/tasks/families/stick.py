"""What the two stick tasks share."""

from mme_vla.envs.scene.predicates import reset_reached
from mme_vla.envs.subtasks import NO_RECORD, SubTask
from mme_vla.envs.task import RESET_QPOS, Task


def back_to_start(env: Task, steps: int = 30) -> list[SubTask]:
    """From the video to the execution: the arm goes home, then to where its first approach ended."""
    return [
        SubTask(
            NO_RECORD,
            done=lambda: env.after_video and reset_reached(env, RESET_QPOS),
            run=lambda demo: demo.hard_reset(steps),
            video=True,
        ),
        SubTask(
            NO_RECORD,
            done=lambda: env.stored_qpos is not None and reset_reached(env, env.stored_qpos),
            run=lambda demo: demo.hard_reset(qpos=env.stored_qpos),
            video=True,
        ),
    ]
