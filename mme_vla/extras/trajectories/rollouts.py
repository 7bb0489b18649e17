"""`rollouts`: episodes as data to learn from, with what the policy saw, what it sampled, and what
came of it.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.backbone.flow import HasFlowHead
from mme_vla.config.sections import read_section
from mme_vla.envs.make import make_env
from mme_vla.envs.vector.pool import Job, Reply, VecEnv
from mme_vla.errors import UserError, check_known, require
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.environment import EpisodeFactory, Report
from mme_vla.evaluation.rollout.runner import Rollout
from mme_vla.evaluation.rollout.running import RunningEpisode
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.trajectories.choice import ChoiceHead
from mme_vla.extras.trajectories.local import LocalEnvs
from mme_vla.extras.trajectories.log_prob import SamplePath, log_prob, sample_path
from mme_vla.memory.base import stack_history
from mme_vla.policy.base import choose_actions
from mme_vla.policy.mme import MMEPolicy
from mme_vla.registry import REWARDS
from mme_vla.types import Batch, HistoryTokens, Labels, TensorStruct

KEEP = ("observations", "rewards", "log_probs", "oracle")

ARGUMENTS_INSTEAD = {
    "task": "the jobs",
    "split": "the jobs",
    "episode": "the jobs",
    "max_steps": "rollouts(…, max_steps=…)",
    "base": "rollouts(…, env=…)",
    "robot": "the policy's embodiment",
    "oracle": 'rollouts(…, keep=["oracle"]), or oracle_share=…',
}
"""Names that `env_options` may not have → what sets them instead."""


@dataclass(frozen=True)
class Trajectory:
    """One episode, decision by decision; t decisions. What `keep` leaves out is None.

    job: which episode.
    outcome: `success`, `fail`, `timeout` or `error`.
    steps: control steps.
    error: of an episode that an error ended, its message. Before the first decision t is 0, and
        there are no rows.
    chunks: [t, h, a], sampled, in the network's units.
    actions: float32 [n, w] of each decision, executed.
    observations: rows of what the policy saw, with the memory's selection; `actions` are the
        executed ones in the network's units, `action_mask` marks them.
    rewards: [t], of the actions of each decision.
    log_probs: [t], of the executed choices (`log_prob`) or of the sampled path (`path_log_prob`).
    paths: of a flow with `backbone.head.deviation`, the states [t, k + 1, h, a] from noise to
        chunk.
    oracle: `observations` of the decisions at which the oracle had an action, with its actions as
        `actions`.
    """

    job: Job
    outcome: str
    steps: int
    chunks: Tensor
    actions: tuple[np.ndarray, ...]
    observations: Batch | None = None
    rewards: Tensor | None = None
    log_probs: Tensor | None = None
    paths: Tensor | None = None
    oracle: Batch | None = None
    error: str | None = None

    @property
    def success(self) -> bool:
        return self.outcome == "success"

    @property
    def total_reward(self) -> float:
        """The sum of all rewards."""
        require(self.rewards is not None, 'This trajectory has no rewards: add "rewards" to keep.')
        assert self.rewards is not None
        return float(self.rewards.sum())


def rollouts(
    policy: MMEPolicy,
    env: str | Callable[..., Any],
    jobs: Sequence[Job],
    keep: Sequence[str] = ("observations", "rewards"),
    *,
    reward: str = "sparse",
    oracle_share: float = 0.0,
    workers: int = 0,
    env_options: Mapping[str, Any] | None = None,
    **settings: Any,
) -> Iterator[Trajectory]:
    """Run episodes with a policy, and yield each as a trajectory when it ends.

    Every job yields one. An episode that an error ended is tried again `retries` times first.

    Args:
        policy: with statistics; its weights may change between two calls, not during one.
        env: a name as `env=` of the commands, or a function that makes an environment with the
            benchmark's interface from `task`, `split`, `episode` and `max_steps`. It may have a
            method `oracle()` (`mme_vla.envs.oracle`).
        jobs: the episodes, `Job(task, split, episode)`.
        keep: of `observations`, `rewards`, `log_probs` and `oracle`.
        reward: a name in `REWARDS`, for env="mme_vla"; functions return rewards of their own.
        oracle_share: share of the decisions at which the oracle acts in place of the policy, 0 to
            1.
        workers: processes that simulate; 0 simulates in this process, without starting any.
        env_options: further arguments of the environment, such as
            `{"seed": 7, "difficulty": "easy"}`.
        settings: of `RolloutSettings`, such as `seed` of the policy's noise, `max_steps`,
            `max_batch`.

    Raises:
        UserError: an unknown name, something to keep that this policy or environment does not
            have, or something in `env_options` that another argument sets.
    """
    require(
        len(set(jobs)) == len(jobs), "jobs has an episode twice: run it again with another seed=…."
    )
    for name in keep:
        check_known("part of a trajectory", name, KEEP)
    require(0 <= oracle_share <= 1, f"oracle_share={oracle_share} must lie between 0 and 1.")
    if not isinstance(policy, MMEPolicy):
        raise UserError(
            f"rollouts() needs a policy of kind mme, and this is a {type(policy).__name__}."
        )
    if "log_probs" in keep:
        check_log_prob(policy)
        require(
            not oracle_share,
            "log_probs are of the policy's own choices: keep none with oracle_share.",
        )
    run_settings = read_section(
        RolloutSettings, settings if callable(env) else {**settings, "env": env}
    )
    options = dict(env_options or {})
    for name, argument in ARGUMENTS_INSTEAD.items():
        require(
            name not in options,
            f"env_options[{name!r}] is no option of the environment: set it by {argument}.",
        )
    oracle = "oracle" in keep or oracle_share > 0
    require(
        not oracle or policy.embodiment.action.choice,
        "The oracle chooses among options: use embodiment=robomme_choice, or keep no oracle.",
    )
    if not callable(env):
        check_known("reward", reward, REWARDS)
    make = EpisodeFactory(
        policy.embodiment,
        run_settings.env,
        env if callable(env) else make_env,
        options,
        render=run_settings.render,
        reward=reward,
        max_steps=run_settings.limit_of,
        oracle=oracle,
    )
    envs: VecEnv | LocalEnvs = LocalEnvs(make)
    if workers:
        envs = VecEnv([], workers, make, run_settings.timeout_s)
    collector = _Collector(policy, envs, run_settings, tuple(keep), oracle_share)
    with envs:
        for _ in collector.rounds(list(jobs)):
            while collector.finished:
                yield collector.finished.pop(0)
        yield from collector.finished


def check_log_prob(policy: MMEPolicy) -> None:
    """Make sure that what this policy samples has a probability."""
    head = policy.backbone.head if isinstance(policy.backbone, HasFlowHead) else None
    require(
        head is not None and (isinstance(head, ChoiceHead) or head.deviation > 0),
        'keep="log_probs": this policy samples without a density. Set backbone.head.name=choice, or'
        " backbone.head.deviation=0.1 of a flow.",
    )


def join(batches: Sequence[Batch]) -> Batch:
    """The rows of several batches as one, prompts padded to the longest.

    Raises:
        UserError: some batches have a field that others lack. Where None counts all rows alike
            (`weight`, `action_mask`, `options`) it becomes ones instead.
    """
    require(batches, "There are no rows to join.")
    require(
        all(batch is not None for batch in batches),
        "None has no rows to join: leave out trajectories that an error ended before their first"
        " decision.",
    )
    require(
        len({tuple(batch.labels) for batch in batches}) == 1,
        "The batches to join have different labels.",
    )
    length = max(batch.prompt.shape[1] for batch in batches)
    joined: dict[str, Any] = {}
    for member in fields(Batch):
        name = member.name
        values = [getattr(batch, name) for batch in batches]
        known = [value for value in values if value is not None]
        if name in ("prompt", "prompt_mask"):
            values = [functional.pad(value, (0, length - value.shape[1])) for value in values]
        elif known and name in ("weight", "action_mask", "options"):
            for i, batch in enumerate(batches):
                if values[i] is None:
                    values[i] = known[0].new_ones(len(batch.prompt), *known[0].shape[1:])
        elif len(known) not in (0, len(values)):
            raise UserError(
                f"{len(known)} of {len(values)} batches to join have {name!r}: give it to all, or"
                " to none."
            )
        joined[name] = _cat(values)
    return Batch(**joined)


def _cat(values: Sequence[Any]) -> Any:
    """Tensors, labels or structs of tensors as one; of anything else the first."""
    first = values[0]
    if isinstance(first, HistoryTokens):
        rows: list[HistoryTokens] = []
        for history in values:
            rows += [history._map(lambda x, i=i: x[i]) for i in range(len(history.mask))]
        return stack_history(rows)
    if isinstance(first, Labels):
        return Labels({name: torch.cat([value[name] for value in values]) for name in first})
    if isinstance(first, TensorStruct):
        members: dict[str, Any] = {}
        for member in fields(first):  # type: ignore[arg-type]
            members[member.name] = _cat([getattr(value, member.name) for value in values])
        return type(first)(**members)
    if isinstance(first, Tensor):
        return torch.cat(list(values))
    return first


@torch.no_grad()
def with_view_tokens(policy: MMEPolicy, batch: Batch, size: int = 32) -> Batch:
    """The rows with the vision tower's tokens, so that a tower that does not learn runs once for
    each row.
    """
    tokens = []
    with policy.autocast():
        for start in range(0, len(batch.prompt), size):
            rows = batch.rows(slice(start, start + size)).to(policy.device)
            images = policy.model.prepare_images(rows).images  # b v 3 s s
            encoded = policy.backbone.encode_images(images.flatten(0, 1))
            tokens.append(encoded.unflatten(0, images.shape[:2]))
    return replace(batch, view_tokens=torch.cat(tokens))


@dataclass
class _Decision:
    """One decision of a running episode."""

    state: Tensor
    chunk: Tensor
    actions: np.ndarray
    oracle: np.ndarray | None
    row: Batch | None = None
    log_prob: Tensor | None = None
    path: Tensor | None = None
    reward: float = 0.0


class _Collector(Rollout):
    """A rollout that keeps every decision, and makes a trajectory of each episode.

    keep, oracle_share: as for `rollouts`.
    finished: trajectories that were not yielded yet.
    """

    policy: MMEPolicy

    def __init__(
        self,
        policy: MMEPolicy,
        envs: Any,
        settings: RolloutSettings,
        keep: Sequence[str],
        oracle_share: float,
    ) -> None:
        facts = RunKey("rollouts", "rollouts", settings.seed, settings.split)
        super().__init__(policy, envs, facts, settings, record=lambda record: None)
        self.keep, self.oracle_share = keep, oracle_share
        self.finished: list[Trajectory] = []
        self._decisions: dict[RunningEpisode, list[_Decision]] = defaultdict(list)
        self._oracle: dict[RunningEpisode, np.ndarray | None] = {}

    def on_reply(self, running: RunningEpisode, reply: Reply) -> None:
        """Note the reward and what was executed of the last decision, and the oracle's next one."""
        report = Report() if reply.error else reply.info
        self._oracle[running] = report.oracle
        decisions = self._decisions[running]
        if reply.is_reset or not decisions:
            return
        last = decisions[-1]
        last.reward += float(reply.reward)
        if running.events.holding is None:
            last.actions = last.actions[: report.executed]

    @torch.no_grad()
    def choose(self, batch: Sequence[RunningEpisode]) -> np.ndarray:
        """The chunks of the policy, or of the oracle where it acts; every decision is kept."""
        policy = self.policy
        episodes = [running.episode for running in batch]
        observations: list[Batch] = []
        paths: list[SamplePath] = []

        def sample_chunk(observation: Batch, noise: Mapping[str, Tensor]) -> Tensor:
            observations.append(_with_memory(policy, observation, batch))
            if "increments" in noise and "log_probs" in self.keep:
                deviation = policy.backbone.head.deviation  # type: ignore[union-attr]
                paths.append(sample_path(policy, observations[0], deviation, **noise))  # type: ignore[arg-type]
                return paths[0].chunk
            return policy.predict_chunk(observation, episodes, noise, self.settings.flow_steps)

        selection = choose_actions(policy, episodes, sample_chunk=sample_chunk)
        rows = observations[0]
        path = paths[0] if paths else None
        execute = self.settings.execute or policy.embodiment.action.execute
        log_probs = None
        if path is not None:
            log_probs = path.log_prob
        elif "log_probs" in self.keep:
            log_probs = log_prob(policy, rows, selection.chunk, execute=execute)

        actions = selection.actions.copy()
        for i, running in enumerate(batch):
            oracle = self._oracle.get(running)
            if self.oracle_share and oracle is not None:
                # A function of seed, episode and number of the decision
                number = len(self._decisions[running])
                job = running.job
                key = [self.settings.seed, job.episode, number, *job.task.encode()]
                if np.random.default_rng(key).random() < self.oracle_share:
                    actions[i] = oracle
                    running.episode.acted(actions[i])
            decision = _Decision(
                running.episode.state, selection.chunk[i], actions[i][:execute], oracle
            )
            if {"observations", "oracle"} & set(self.keep):
                decision.row = rows.rows(slice(i, i + 1)).to("cpu")
            if log_probs is not None:
                decision.log_prob = log_probs[i].cpu()
            if path is not None:
                decision.path = path.states[i].cpu()
            self._decisions[running].append(decision)
        return actions

    def on_end(
        self, running: RunningEpisode, outcome: str, reason: str | None, again: bool
    ) -> None:
        """Make a trajectory of the episode, unless it is tried again."""
        decisions = self._decisions.pop(running, [])
        self._oracle.pop(running, None)
        if not again:
            self.finished.append(self._trajectory(running, outcome, reason, decisions))

    def _trajectory(
        self,
        running: RunningEpisode,
        outcome: str,
        reason: str | None,
        decisions: Sequence[_Decision],
    ) -> Trajectory:
        chunks: list[Tensor] = []
        actions: list[np.ndarray] = []
        rewards: list[float] = []
        log_probs: list[Tensor] = []
        paths: list[Tensor] = []
        executed: list[Batch] = []
        targets: list[Batch] = []
        for decision in decisions:
            chunks.append(decision.chunk)
            actions.append(decision.actions)
            rewards.append(decision.reward)
            if decision.log_prob is not None:
                log_probs.append(decision.log_prob)
            if decision.path is not None:
                paths.append(decision.path)
            if decision.row is None:
                continue
            executed.append(self._labelled(decision.row, decision.state, decision.actions))
            if decision.oracle is not None:
                by_oracle = decision.oracle[None]
                targets.append(self._labelled(decision.row, decision.state, by_oracle))
        stacked_chunks = torch.zeros(0, self.policy.horizon, self.policy.action_dim)
        if chunks:
            stacked_chunks = torch.stack(chunks)
        return Trajectory(
            running.job,
            outcome,
            running.steps,
            stacked_chunks,
            tuple(actions),
            observations=join(executed) if "observations" in self.keep and executed else None,
            rewards=torch.tensor(rewards) if "rewards" in self.keep else None,
            log_probs=torch.stack(log_probs) if log_probs else None,
            paths=torch.stack(paths) if paths else None,
            oracle=join(targets) if "oracle" in self.keep and targets else None,
            error=reason if outcome == "error" else None,
        )

    def _labelled(self, row: Batch, state: Tensor, actions: np.ndarray) -> Batch:
        """A row with these actions [n, w] in the network's units, repeated to a chunk, of which
        they alone count.
        """
        processor = self.policy.require_processor()
        horizon = self.policy.horizon
        before = processor.samples.window - 1
        count = len(actions)
        if count:
            last = actions[-1:]
        else:
            last = np.zeros((1, self.policy.embodiment.action.width), np.float32)
        after = horizon - before - count
        chunk = np.concatenate([last.repeat(before, 0), actions, last.repeat(after, 0)])
        mask = torch.zeros(1, horizon, dtype=torch.bool)
        mask[:, before : before + count] = True
        return replace(row, actions=processor.actions(chunk, state)[None], action_mask=mask)


def _with_memory(policy: MMEPolicy, observation: Batch, batch: Sequence[RunningEpisode]) -> Batch:
    """The observation with the memory's selection and the options, as a row of training data has
    them.
    """
    history = None
    options = None
    if policy.memory is not None:
        selections = [running.episode.gather_selection() for running in batch]
        history = stack_history(selections, policy.device)
    if letters := len(policy.embodiment.action.choice):
        options = torch.zeros(len(batch), letters, dtype=torch.bool, device=policy.device)
        for i, running in enumerate(batch):
            options[i, [option.number for option in running.episode.options]] = True
    return replace(observation, history=history, options=options)
