"""The oracle bracket of a nano run: the demonstrator's motions, handed to the environment as a policy hands its own.

It knows where everything is, so what it fails in is out of reach of any policy that acts by planned motions.
"""

from dataclasses import dataclass

from mme_vla.data.waypoints import Motions
from mme_vla.envs.make import make_env, make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.evaluation.records import EpisodeRecord

NAME = "planner"
ACTIONS = "waypoint"


@dataclass(frozen=True)
class Replay:
    """An episode to be solved by its demonstrator's motions, within so many control steps."""

    spec: EpisodeSpec
    max_steps: int


def replay(job: Replay) -> EpisodeRecord:
    """Demonstrate an episode out of sight, and repeat the motions in the environment that policies meet."""
    spec = job.spec
    motions = _planned(spec)
    env = make_env(spec.task, spec.split, spec.episode, ACTIONS, max_steps=job.max_steps, render=False)
    status = "fail"
    try:
        env.reset()
        for target in () if motions is None else motions.targets:
            *_, info = env.step(target)
            status = str(info["status"])
            if status != "ongoing":
                break
        steps = env.steps_counted  # type: ignore[union-attr]  # the official environment is not asked for
    finally:
        env.close()
    return EpisodeRecord(
        NAME, "none", 0, spec.task, spec.episode, spec.seed, spec.difficulty,
        status if status in ("success", "fail", "timeout") else "fail", steps, split=spec.split,
        max_steps=job.max_steps, action_space=ACTIONS, extra={"status": status, "demonstrated": motions is not None},
    )  # fmt: skip


def _planned(spec: EpisodeSpec) -> Motions | None:
    from mme_vla.envs.recording.frames import motions_of
    from mme_vla.envs.recording.recorder import Recorder
    from mme_vla.envs.scene.placement import SceneError

    try:
        env = make_task(spec.task, render=False, seed=spec.seed, difficulty=spec.difficulty)
    except SceneError:
        return None
    try:
        result = Recorder(env, render=False).record()
        return motions_of(result.frames) if result.success else None
    finally:
        env.close()
