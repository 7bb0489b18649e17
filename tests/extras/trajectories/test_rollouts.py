"""Rollouts as data: rows, rewards, log-probabilities and the oracle's actions, on an environment of
one decision.
"""

import re
import runpy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from helpers import REPOSITORY
from helpers.scripted_env import ScriptedEnv
from mme_vla import MMEPolicy, UserError, build_policy, register
from mme_vla.embodiment.robomme import ROBOMME_JOINT
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.rollout.environment import ChunkCommand, ChunkEnv
from mme_vla.extras.trajectories.log_prob import SamplePath, log_prob, path_log_prob
from mme_vla.extras.trajectories.rollouts import ARGUMENTS_INSTEAD, join, rollouts
from mme_vla.processing.normalise import NormStats
from mme_vla.registry import REWARDS
from mme_vla.types import Labels

EXAMPLES = REPOSITORY / "examples" / "trajectories"
JOBS = [Job("TwoChoices", "train", episode) for episode in range(4)]
ALL = ("observations", "rewards", "log_probs", "oracle")
two_choices = runpy.run_path(str(EXAMPLES / "two_choices.py"))["make_two_choices"]


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    built = build_policy(
        "framesamp_modul",
        backbone="nano_choice",
        embodiment="robomme_choice_front",
        memory={"budget": 4, "grid": 1},
    )
    built.require_processor().stats = NormStats.unit(8, 10)
    return built.eval()


def test_a_trajectory_holds_rows_rewards_and_the_log_probabilities_of_its_choices(
    policy: MMEPolicy,
) -> None:
    trajectories = list(rollouts(policy, two_choices, JOBS, ALL, seed=1))
    assert [t.job for t in trajectories] == JOBS
    for number, trajectory in enumerate(trajectories):
        rows = trajectory.observations
        (executed,) = trajectory.actions
        assert executed.shape == (1, 10)
        right = int(executed[0].argmax()) == number % 2
        assert trajectory.success == right and trajectory.total_reward == float(right)
        assert int(rows.actions[0, 0, :8].argmax()) == int(executed[0, :8].argmax())
        assert rows.action_mask is not None and rows.action_mask.tolist() == [
            [True, False, False, False]
        ]
        assert rows.options is not None and rows.options.tolist() == [[True, True, *[False] * 6]]
        assert torch.allclose(
            log_prob(policy, rows, trajectory.chunks), trajectory.log_probs, atol=1e-5
        )
        assert int(trajectory.oracle.actions[0, 0, :8].argmax()) == number % 2
    batch = join([t.observations for t in trajectories if t.observations is not None])
    loss, _ = policy(batch)
    assert (
        torch.isfinite(loss) and batch.history is not None and len(batch.history.mask) == len(JOBS)
    )


def test_rows_are_joined_with_their_weights_and_labels(policy: MMEPolicy) -> None:
    one, two = (t.observations for t in rollouts(policy, two_choices, JOBS[:2], ("observations",)))
    labelled = [
        replace(one, weight=torch.tensor([0.5]), labels=Labels(grasp=torch.tensor([1.0]))),
        replace(two, action_mask=None, labels=Labels(grasp=torch.tensor([2.0]))),
    ]
    both = join(labelled)
    assert both.weight is not None and both.weight.tolist() == [0.5, 1.0]  # none counts as 1
    assert both.labels["grasp"].tolist() == [1.0, 2.0]
    assert both.action_mask is not None and both.action_mask.sum(1).tolist() == [1, 4]
    with pytest.raises(UserError, match="1 of 2 batches to join have 'history'"):
        join([one, replace(two, history=None)])
    with pytest.raises(UserError, match="different labels"):
        join([labelled[0], two])


def test_an_episode_that_cannot_begin_is_a_trajectory_without_decisions(policy: MMEPolicy) -> None:
    def make_env(task: str, split: str, episode: int, max_steps: int) -> Any:
        if episode == 1:
            raise RuntimeError("no place for the cube")
        return two_choices(task, split, episode, max_steps)

    trajectories = {t.job: t for t in rollouts(policy, make_env, JOBS[:3], ALL)}
    assert set(trajectories) == set(JOBS[:3])
    failed = trajectories[JOBS[1]]
    assert (
        failed.outcome == "error"
        and failed.error is not None
        and "no place for the cube" in failed.error
    )
    assert (
        failed.chunks.shape == (0, 4, 10)
        and failed.total_reward == 0.0
        and failed.observations is None
    )
    assert trajectories[JOBS[0]].error is None and len(trajectories[JOBS[0]].chunks) == 1


def test_an_error_in_a_step_ends_its_episode_alone(policy: MMEPolicy) -> None:
    def step(action: Any) -> Any:
        raise RuntimeError("the simulator diverged")

    def make_env(task: str, split: str, episode: int, max_steps: int) -> Any:
        env = two_choices(task, split, episode, max_steps)
        if episode == 1:
            env.step = step
        return env

    trajectories = {t.job: t for t in rollouts(policy, make_env, JOBS[:3], ())}
    broken = trajectories[JOBS[1]]
    assert broken.outcome == "error" and "the simulator diverged" in str(broken.error)
    assert [trajectories[job].error for job in (JOBS[0], JOBS[2])] == [None, None]


def test_the_same_seed_repeats_a_rollout_and_another_does_not(policy: MMEPolicy) -> None:
    chunks = [
        torch.cat([t.chunks for t in rollouts(policy, two_choices, JOBS, (), seed=seed)])
        for seed in (1, 1, 2)
    ]
    assert torch.equal(chunks[0], chunks[1]) and not torch.equal(chunks[0], chunks[2])


def test_the_oracle_acts_in_the_share_of_decisions_that_is_asked_for(policy: MMEPolicy) -> None:
    assert all(t.success for t in rollouts(policy, two_choices, JOBS, (), oracle_share=1.0))


def test_paths_of_a_flow_are_kept_with_their_log_probabilities() -> None:
    built = build_policy(
        "pi05", backbone="nano", embodiment="robomme_choice_front",
        **{"backbone.action_dim": 10, "+backbone.head.deviation": 0.1},
    )  # fmt: skip
    built.require_processor().stats = NormStats.unit(8, 10)
    (trajectory,) = rollouts(built.eval(), two_choices, JOBS[:1], ("observations", "log_probs"))
    paths = trajectory.paths
    assert paths.shape == (1, 11, 4, 10) and torch.equal(paths[:, -1], trajectory.chunks)
    again = path_log_prob(built, trajectory.observations, SamplePath(paths, 0.1, None))
    assert torch.allclose(again, trajectory.log_probs, rtol=1e-5)


def test_what_cannot_be_kept_is_refused(policy: MMEPolicy) -> None:
    with pytest.raises(UserError, match="Unknown part of a trajectory 'reward'"):
        next(rollouts(policy, two_choices, JOBS, ("reward",)))
    with pytest.raises(UserError, match="the policy's own choices"):
        next(rollouts(policy, two_choices, JOBS, ("log_probs",), oracle_share=0.5))
    with pytest.raises(UserError, match="episode twice"):
        next(rollouts(policy, two_choices, [JOBS[0], JOBS[0]]))
    with pytest.raises(UserError, match="Unknown reward 'dense'"):
        next(rollouts(policy, "mme_vla", JOBS, reward="dense"))
    joints = build_policy("pi05", backbone="nano")
    with pytest.raises(UserError, match="samples without a density"):
        next(rollouts(joints, two_choices, JOBS, ("log_probs",)))
    with pytest.raises(UserError, match="chooses among options"):
        next(rollouts(joints, two_choices, JOBS, ("oracle",)))


class Rewarding(ScriptedEnv):
    """Gives one point for each action."""

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, _, terminated, truncated, info = super().step(action)
        return observation, 1.0, terminated, truncated, info


@pytest.mark.parametrize("name", ARGUMENTS_INSTEAD)
def test_what_another_argument_sets_is_no_option_of_the_environment(
    name: str, policy: MMEPolicy
) -> None:
    with pytest.raises(UserError, match=rf"env_options\['{name}'\] is no option.*set it by"):
        next(rollouts(policy, two_choices, JOBS, env_options={name: 7}))


def test_the_reward_of_a_chunk_is_the_sum_over_its_actions() -> None:
    env = ChunkEnv(lambda: Rewarding("PickXtimes", 0, 40, 1e9, 0.0, ""), robot=ROBOMME_JOINT)
    env.reset()
    assert env.step(ChunkCommand(np.zeros((5, 8))))[1] == 5.0


def test_a_reward_of_your_own_is_registered_by_name() -> None:
    @register("reward", "half")
    def half(progress: Any, success: bool) -> float:
        return success / 2

    assert REWARDS["half"] is half and {"none", "sparse", "subtask"} <= set(REWARDS)


@pytest.mark.nightly
@pytest.mark.parametrize("example", ["grpo", "reward_weighted"])
def test_an_example_learns_the_right_choices(example: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    first, last = runpy.run_path(str(EXAMPLES / f"{example}.py"))["main"]()
    assert first < 0.7 and last >= 0.9


def test_the_code_of_the_page_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLES)
    page = (REPOSITORY / "docs" / "extend" / "trajectories.md").read_text()
    space: dict[str, Any] = {"__name__": "page"}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(compile(block, "docs/extend/trajectories.md", "exec"), space)
    assert all(t.rewards is not None for t in space["trajectories"])
