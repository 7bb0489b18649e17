"""Rollouts with every frame and with those alone that the policy reads."""

from typing import Any

from helpers.rollout_fakes import InlineEnvs, roll
from helpers.scripted_env import ScriptedEnv
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.records import EpisodeRecord

STEPS = 70
JOBS = [Job("VideoUnmask", "test", 0), Job("PickXtimes", "test", 1)]


class WatchedEnv(ScriptedEnv):
    """Draws only what it is asked for, as the simulated environments do; counts its images by
    camera.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.render_request: RenderRequest | None = None
        self.rendered = {"front": 0, "wrist": 0}

    def _lists(self, frames: list[dict[str, Any]]) -> dict[str, Any]:
        first = len(self.frames) - len(frames)
        for number, frame in enumerate(frames, first):
            newest = number == len(self.frames) - 1
            cameras = (
                ("front", "wrist")
                if self.render_request is None
                else self.render_request.cameras(number, newest)
            )
            for camera in self.rendered:
                self.rendered[camera] += camera in cameras
                frame[f"{camera}_rgb"] = frame[f"{camera}_rgb"] if camera in cameras else None
        return super()._lists(frames)


def make_watched_env(task: str, split: str, episode: int, max_steps: int) -> WatchedEnv:
    return WatchedEnv(task, episode, max_steps, 1e9, 0.0, "")


def outcomes(records: list[EpisodeRecord]) -> list[tuple[Any, ...]]:
    assert all(record.error is None for record in records)
    return [(r.key, r.outcome, r.steps, r.actions_sha256, r.subgoals) for r in records]


def both_ways(
    policy: Any, subgoals: Any = None, base: Any = make_watched_env
) -> list[dict[str, int]]:
    """Run with all images rendered and with those needed; check that both agree; return what each
    rendered.
    """
    counts = []
    results = []
    for draw in ("all", "needed"):
        envs = InlineEnvs(base=base, max_steps=STEPS - 1)
        records = roll(policy, JOBS, envs, subgoals, draw=draw, max_steps=STEPS - 1, max_batch=1)
        assert [record.steps for record in records] == [STEPS, STEPS], (
            "an episode should take several chunks"
        )
        results.append(outcomes(records))
        if base is make_watched_env:
            counts += [env.rendered for env in envs.made.values()]
    assert results[0] == results[1]
    return counts
