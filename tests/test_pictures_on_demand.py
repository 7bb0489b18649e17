"""Rollouts draw what is looked at, and nothing changes: actions and outcomes are those of drawing everything."""

from typing import Any

import numpy as np
import pytest
from rollout_scripted_env import VIDEO, ScriptedEnv, make_scripted_env
from rollout_stand_ins import InlineEnvs, quick_policy, roll

from mme_vla import UserError
from mme_vla.envs.drawing import Drawing
from mme_vla.envs.vector.jobs import Job
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.environment import make_rollout_env
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.subgoal import SubgoalPredictor
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode
from mme_vla.subgoal.oracle import Oracle

STEPS = 70
JOBS = [Job("VideoUnmask", "test", 0), Job("PickXtimes", "test", 1)]
FRAMES = [VIDEO[JOBS[0].task] + 1 + STEPS, 1 + STEPS]
MEMORIES: dict[str, dict[str, Any]] = {
    "pi05": {},
    "framesamp_modul": {"memory": {"budget": 64}},
    "tokendrop_expert": {"memory": {"budget": 64}},
    "ttt_context": {},
    "rmt_modul": {},
    "framesamp_ttt_expert": {},
}


class WatchedEnv(ScriptedEnv):
    """Draws only what it is asked for, as the simulated environments do; counts its pictures by camera."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.drawing: Drawing | None = None
        self.drawn = {"front": 0, "wrist": 0}

    def _lists(self, frames: list[dict[str, Any]]) -> dict[str, Any]:
        first = len(self.frames) - len(frames)
        for number, frame in enumerate(frames, first):
            newest = number == len(self.frames) - 1
            shown = ("front", "wrist") if self.drawing is None else self.drawing.cameras(number, newest)
            for camera in self.drawn:
                self.drawn[camera] += camera in shown
                frame[f"{camera}_rgb"] = frame[f"{camera}_rgb"] if camera in shown else None
        return super()._lists(frames)


def make_watched_env(task: str, split: str, episode: int, max_steps: int) -> WatchedEnv:
    return WatchedEnv(task, episode, max_steps, 1e9, 0.0, "")


def outcomes(records: list[EpisodeRecord]) -> list[tuple[Any, ...]]:
    assert all(record.error is None for record in records)
    return [(r.key, r.outcome, r.steps, r.extra["actions_sha256"], r.extra.get("subgoals")) for r in records]


def both_ways(policy: Any, subgoals: Any = None, base: Any = make_watched_env) -> list[dict[str, int]]:
    """Roll with everything drawn and with what is needed; check that they agree; what was drawn, each way."""
    counts = []
    found = []
    for draw in ("all", "needed"):
        envs = InlineEnvs(base=base, max_steps=STEPS - 1)
        records = roll(policy, JOBS, envs, subgoals, draw=draw, max_steps=STEPS - 1, max_batch=1)
        assert [record.steps for record in records] == [STEPS, STEPS], "an episode should take several chunks"
        found.append(outcomes(records))
        if base is make_watched_env:
            counts += [env.drawn for env in envs.made.values()]
    assert found[0] == found[1]
    return counts


@pytest.mark.parametrize("name", MEMORIES)
def test_drawing_what_is_needed_changes_no_action(name: str) -> None:
    policy = quick_policy(name, patch_size=8 if name != "pi05" else 16, **MEMORIES[name])
    *everything, video, plain = both_ways(policy)
    assert everything == [{"front": n, "wrist": n} for n in FRAMES]
    chunks = -(-STEPS // 16)
    last = STEPS % 16 > 0  # the step limit cuts the last chunk short: nobody acts on its end
    assert video["wrist"] == plain["wrist"] == 1 + chunks - last
    memory = policy.memory
    if memory is None:
        assert video["front"] == plain["front"] == plain["wrist"]
    else:
        assert plain["front"] < FRAMES[1] and video["front"] < FRAMES[0]


def test_an_environment_that_draws_everything_gives_the_same_results() -> None:
    both_ways(quick_policy("ttt_modul", patch_size=8), base=make_scripted_env)
