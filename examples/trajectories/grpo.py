"""GRPO: each episode is played several times, and what did better than its group becomes more
probable.
"""

import torch
from two_choices import make_two_choices

from mme_vla import MMEPolicy, build_policy
from mme_vla.envs.vector.pool import Job
from mme_vla.extras.trajectories.log_prob import log_prob
from mme_vla.extras.trajectories.rollouts import Trajectory, join, rollouts, with_view_tokens
from mme_vla.processing.normalise import NormStats

JOBS = [Job("TwoChoices", "train", episode) for episode in range(4)]
CLIP = 0.2  # of the probability ratio, either way


def play(policy: MMEPolicy, seed: int) -> list[Trajectory]:
    keep = ("observations", "rewards", "log_probs")
    return sorted(
        rollouts(policy, make_two_choices, JOBS, keep, seed=seed), key=lambda t: t.job.episode
    )


def tower_free(policy: MMEPolicy) -> list[torch.nn.Parameter]:
    """The parameters that learn: all but those of the pretrained vision tower."""
    policy.backbone.vision.requires_grad_(False)
    return [parameter for parameter in policy.parameters() if parameter.requires_grad]


def update(
    policy: MMEPolicy, optimizer: torch.optim.Optimizer, groups: list[list[Trajectory]], epochs: int
) -> None:
    returns = torch.tensor([[t.total_reward for t in group] for group in groups])
    advantages = (returns - returns.mean(0)) / (returns.std(0) + 1e-6)  # in the group of an episode
    trajectories = [t for group in groups for t in group]
    advantages = advantages.flatten().repeat_interleave(
        torch.tensor([len(t.chunks) for t in trajectories])
    )
    rows = with_view_tokens(policy, join([t.observations for t in trajectories]))
    chunks = torch.cat([t.chunks for t in trajectories])
    before = torch.cat([t.log_probs for t in trajectories])
    for _ in range(epochs):
        ratio = (log_prob(policy, rows, chunks) - before).exp()
        gain = torch.minimum(ratio * advantages, ratio.clamp(1 - CLIP, 1 + CLIP) * advantages)
        optimizer.zero_grad()
        (-gain.mean()).backward()
        optimizer.step()


def main(rounds: int = 12, group: int = 6, epochs: int = 4) -> tuple[float, float]:
    """Success rates before and after."""
    policy = build_policy("pi05", backbone="nano_choice", embodiment="robomme_choice_front", seed=0)
    policy.require_processor().stats = NormStats.unit(8, 10)
    optimizer = torch.optim.AdamW(tower_free(policy), 1e-3)
    rates = []
    for step in range(rounds):
        groups = [play(policy, seed=step * group + member) for member in range(group)]
        rates.append(sum(t.success for g in groups for t in g) / (group * len(JOBS)))
        print(f"round {step}: success {rates[-1]:.2f}")
        update(policy, optimizer, groups, epochs)
    return rates[0], rates[-1]


if __name__ == "__main__":
    main()
