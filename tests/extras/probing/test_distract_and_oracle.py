"""Unrelated episodes before one's own, and the frames an oracle keeps, in closed loop."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.probe_fakes import made_up
from helpers.rollout_fakes import FACTS, InlineEnvs, quick_policy, roll
from helpers.scripted_env import ScriptedEnv, make_moving_env
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout.evaluation import RunOptions
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.probing.arms import read_arm
from mme_vla.extras.probing.probed import ProbedEpisode, ProbedPolicy
from mme_vla.extras.probing.recordings import Recording
from mme_vla.extras.probing.run import ProbePlan, run_probe
from mme_vla.extras.probing.settings import OfflineSettings

JOBS = [Job("VideoUnmask", "test", 0), Job("PickXtimes", "test", 1)]
BEGAN = [0, 9, 21, 30, 44]


def test_unrelated_episodes_come_first_in_their_order_and_no_more_than_the_word_says() -> None:
    policy = quick_policy("framesamp_modul", 8).eval()

    def actions_after(word: str, sessions: list[Recording]) -> np.ndarray:
        envs = InlineEnvs(base=make_moving_env)
        roll(ProbedPolicy(policy, read_arm(word), sessions).eval(), JOBS, envs)
        return np.concatenate([np.stack(envs.made[job].actions) for job in JOBS])

    first, second, third = made_up()
    actions = actions_after("distract:2", [first, second, third])
    assert np.array_equal(actions, actions_after("distract:2", [first, second]))
    assert not np.array_equal(actions, actions_after("distract:2", [second, first]))
    assert not np.array_equal(actions, actions_after("pause:0", []))


class TellingEnv(ScriptedEnv):
    """Tells at which frames sub-tasks began, as the simulated environments do."""

    @property
    def began(self) -> list[int]:
        return [frame for frame in BEGAN if frame < len(self.frames)]


def make_telling_env(task: str, split: str, episode: int, max_steps: int) -> TellingEnv:
    return TellingEnv(task, episode, max_steps, 1e9, 0.0, "")


class Noting(ProbedPolicy):
    """Notes the times of what is remembered at every chunk."""

    def snapshot(self, episode: ProbedEpisode, noise: Any = None) -> Any:
        match = super().snapshot(episode, noise)
        self.noted.append(
            (episode.n_observed_frames - 1, [entry.time for entry in match[1][0].entries])
        )
        return match


JOINED = {"memory": [{"name": "framesamp", "budget": 64}, {"name": "ttt", "budget": 64}]}


@pytest.mark.parametrize(
    ("model", "arm"),
    [
        ("framesamp_modul", "oracle"),
        ("framesamp_modul", "pause:8+oracle"),
        ("ttt_modul", "oracle"),
        ("rmt_expert", "pause:8+oracle"),
        ("framesamp_context", "oracle"),
    ],
)
def test_in_closed_loop_an_oracle_keeps_the_frames_at_which_subtasks_began(
    model: str, arm: str
) -> None:
    options = JOINED if model == "framesamp_context" else {}
    probe = Noting(quick_policy(model, 8, **options).eval(), read_arm(arm)).eval()
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
