"""Reward-weighted regression: what the policy did is imitated, weighted by the exponential of its
return.
"""

import torch
from grpo import JOBS, tower_free
from two_choices import make_two_choices

from mme_vla import MMEPolicy, build_policy
from mme_vla.extras.trajectories.log_prob import log_prob
from mme_vla.extras.trajectories.rollouts import Trajectory, join, rollouts, with_view_tokens
from mme_vla.processing.normalise import NormStats

TEMPERATURE = 0.25  # of the returns: smaller imitates the best alone


def update(
    policy: MMEPolicy, optimizer: torch.optim.Optimizer, trajectories: list[Trajectory], epochs: int
) -> None:
    returns = torch.tensor([t.total_reward for t in trajectories])
    counts = torch.tensor([len(t.chunks) for t in trajectories])
    weights = ((returns - returns.max()) / TEMPERATURE).exp().repeat_interleave(counts)
    rows = with_view_tokens(policy, join([t.observations for t in trajectories]))
    chunks = torch.cat([t.chunks for t in trajectories])
    for _ in range(epochs):
        loss = -(weights * log_prob(policy, rows, chunks)).sum() / weights.sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def main(rounds: int = 12, group: int = 6, epochs: int = 4) -> tuple[float, float]:
    """Success rates before and after."""
    policy = build_policy("pi05", backbone="nano_choice", embodiment="robomme_choice_front", seed=0)
    policy.require_processor().stats = NormStats.unit(8, 10)
    optimizer = torch.optim.AdamW(tower_free(policy), 1e-3)
    rates = []
    for step in range(rounds):
        seeds = range(step * group, (step + 1) * group)
        trajectories = [
            t for seed in seeds for t in rollouts(policy, make_two_choices, JOBS, seed=seed)
        ]
        rates.append(sum(t.success for t in trajectories) / len(trajectories))
        print(f"round {step}: success {rates[-1]:.2f}")
        update(policy, optimizer, trajectories, epochs)
    return rates[0], rates[-1]


if __name__ == "__main__":
    main()
