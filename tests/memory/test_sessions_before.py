"""Unrelated episodes before one's own, a dial of the stress split; and the frames an oracle keeps,
in closed loop.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.probe_fakes import actions, made_up
from helpers.rollout_fakes import FACTS, InlineEnvs, quick_policy, records, roll
from helpers.scripted_env import ScriptedEnv, make_moving_env
from mme_vla.envs.make import make_env
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.results.curves import stress_curves
from mme_vla.evaluation.rollout.environment import make_rollout_env
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions, policy_of_split
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.probing.arms import read_arm
from mme_vla.extras.probing.probed import ProbedEpisode, ProbedPolicy, with_sessions
from mme_vla.extras.probing.run import ProbePlan, run_probe
from mme_vla.extras.probing.settings import OfflineSettings

SPLIT = "stress:sessions=2"
JOBS = [Job("VideoUnmask", SPLIT, 0), Job("PickXtimes", SPLIT, 1)]
BEGAN = [0, 9, 21, 30, 44]


def test_a_split_with_sessions_shows_them_first_and_its_records_are_on_the_curve() -> None:
    policy = quick_policy("framesamp_modul", 8).eval()
    before = with_sessions(policy, SPLIT, made_up())
    envs = InlineEnvs(base=make_moving_env)
    roll(before, JOBS, envs)
    # The second of three recordings comes second, and the third is not shown.
    distracted, paused = actions(policy, "distract:2"), actions(policy, "pause:0")
    for job, as_probed, undisturbed in zip(JOBS, distracted, paused, strict=True):
        actions_ = np.stack(envs.made[job].actions)
        assert np.array_equal(actions_, as_probed) and not np.array_equal(actions_, undisturbed)
    curves = stress_curves([*records("test", [1, 1, 0]), *records(SPLIT, [1, 0, 0])])
    ((_, task, dial),) = curves
    points = curves[next(iter(curves))]
    assert (task, dial, [(p.turned, p.won) for p in points]) == (
        "PickXtimes",
        "sessions",
        [(0, 2), (2, 1)],
    )


def test_nobody_evaluates_such_a_split_without_showing_them(tmp_path: Path) -> None:
    policy = quick_policy("framesamp_modul").eval()
    with pytest.raises(UserError, match="2 unrelated episodes come before each, and 0 are shown"):
        options = RunOptions(base=make_moving_env)
        EvaluationRun(policy, JOBS, tmp_path, FACTS, RolloutSettings(split=SPLIT), options).run()
    with pytest.raises(UserError, match="2 unrelated episodes come before each, and 0 are shown"):
        make_env("StopCube", SPLIT)
    with pytest.raises(UserError, match="2 recorded episodes to take from, and there are 1"):
        with_sessions(policy, SPLIT, made_up(1))
    with pytest.raises(UserError, match="split=test shows none"):
        policy_of_split(policy, "test", made_up())
    assert with_sessions(policy, "stress:sessions=0", made_up()) is policy


def test_the_scenes_of_such_a_split_are_those_of_the_test_split() -> None:
    splits = []

    def base(**options: Any) -> ScriptedEnv:
        splits.append(options["split"])
        return make_moving_env(**options)

    make_rollout_env("StopCube", SPLIT, 0, base=base, sessions=2)
    assert splits == ["test"]
    with pytest.raises(UserError, match="2 unrelated episodes come before each, and 1 are shown"):
        make_rollout_env("StopCube", SPLIT, 0, base=base, sessions=1)


class TellingEnv(ScriptedEnv):
    """Tells at which frames sub-tasks began, as the simulated environments do."""

    @property
    def began(self) -> list[int]:
        return [frame for frame in BEGAN if frame < len(self.frames)]


def make_telling_env(task: str, split: str, episode: int, max_steps: int) -> TellingEnv:
    return TellingEnv(task, episode, max_steps, 1e9, 0.0, "")


class Noting(ProbedPolicy):
    """Notes the times of what is remembered at every chunk."""

    def snapshot(self, episode: ProbedEpisode, drawn: Any = None) -> Any:
        match = super().snapshot(episode, drawn)
        self.noted.append(
            (episode.n_observed_frames - 1, [entry.time for entry in match[1][0].entries])
        )
        return match


@pytest.mark.parametrize("arm", ["oracle", "pause:8+oracle"])
def test_in_closed_loop_an_oracle_keeps_the_frames_at_which_subtasks_began(arm: str) -> None:
    probe = Noting(quick_policy("framesamp_modul", 8).eval(), read_arm(arm)).eval()
    probe.noted = []
    roll(
        probe,
        [Job("VideoUnmask", "test", 0)],
        InlineEnvs(base=make_telling_env),
        max_steps=47,
        max_batch=1,
    )
    shift = 8 if "pause" in arm else 0  # from the first execution frame, 21, on
    assert len(probe.noted) == 3
    for now, times in probe.noted:
        began = {frame + (shift if frame >= 21 else 0) for frame in BEGAN if frame <= now}
        assert set(times) == began | {now + shift}


def test_where_nobody_tells_when_subtasks_begin_the_oracle_is_refused(tmp_path: Path) -> None:
    request = ProbePlan(["oracle"], jobs=JOBS, offline=OfflineSettings())
    with pytest.raises(UserError, match="whose beginnings are told"):
        run_probe(
            quick_policy("framesamp_modul").eval(),
            request,
            tmp_path,
            FACTS,
            RolloutSettings(),
            RunOptions(base=make_moving_env, show_progress=False),
        )
