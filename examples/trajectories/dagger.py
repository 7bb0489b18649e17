"""DAgger: the policy acts, the oracle says what it would have chosen, and the policy learns from all of that so far."""

import torch

from mme_vla import MMEPolicy, build_policy, make_env
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.rollouts import join, rollouts, with_view_tokens
from mme_vla.processing.normalise import NormStats
from mme_vla.types import Batch

SCENES = 12  # new ones a round
FIRST_SEED = 3_000_000


def make_easy_env(task: str, split: str, episode: int, **options):
    """An easy scene of a task, by choices; `episode` is its seed."""
    return make_env(task, seed=FIRST_SEED + episode, difficulty="easy", action_space="multi_choice", **options)


def learn(policy: MMEPolicy, optimizer: torch.optim.Optimizer, rows: Batch, updates: int, size: int = 24) -> float:
    policy.train()
    for _ in range(updates):
        index = torch.randint(len(rows.prompt), (size,))
        loss, _ = policy(rows.rows(index))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    policy.eval()
    return loss.item()


def main(rounds: int = 4, updates: int = 120, output: str = "outputs/dagger") -> list[float]:
    """The success rate of each round on scenes that are new to the policy; in the first the oracle acts."""
    policy = build_policy(
        "framesamp_modul", backbone="nano_choice", embodiment="robomme_choice_front", seed=0,
        memory={"budget": 4, "grid": 1, "every": 8}, policy={"augment": False},
        **{"backbone.head.temperature": 0},  # the best option, without noise
    )  # fmt: skip
    policy.backbone.vision.requires_grad_(False)
    policy.require_processor().stats = NormStats.unit(8, 10)
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], 1e-3)
    torch.manual_seed(0)
    data, rates = [], []
    for step in range(rounds):
        jobs = [Job("VideoUnmask", "train", step * SCENES + i) for i in range(SCENES)]
        share = 1.0 if step == 0 else 0.0
        trajectories = list(rollouts(policy, make_easy_env, jobs, ("oracle",), oracle_share=share, max_steps=400))
        rates.append(sum(t.success for t in trajectories) / SCENES)
        data += [t.oracle for t in trajectories if t.oracle is not None]
        if step < rounds - 1:
            loss = learn(policy, optimizer, with_view_tokens(policy, join(data)), updates)
            print(f"round {step}: success {rates[-1]:.2f}, {sum(len(b.prompt) for b in data)} rows, loss {loss:.3f}")
    print(f"round {rounds - 1}: success {rates[-1]:.2f}")
    policy.save_pretrained(output)
    return rates


if __name__ == "__main__":
    main()
