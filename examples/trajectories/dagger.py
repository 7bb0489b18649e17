"""DAgger: the policy acts, the oracle says what it would have chosen, and the policy learns from
all of that so far.
"""

from dataclasses import replace

import torch

from mme_vla import MMEPolicy, build_policy, make_env
from mme_vla.envs.vector.pool import Job
from mme_vla.extras.trajectories.rollouts import join, rollouts, with_view_tokens
from mme_vla.processing.normalise import NormStats
from mme_vla.types import Batch

FIRST_SEED = 3_000_000
POINTS = {8: (0.2, 0.55), 9: (0.25, 0.75)}  # rows and columns of the image where objects are
NOISE = 0.2  # on remembered tokens, so that few demonstrations are learned by heart less


def make_easy_env(task: str, split: str, episode: int, **options):
    """An easy scene of a task, by choices; `episode` is its seed."""
    return make_env(
        task, seed=FIRST_SEED + episode, difficulty="easy", action_space="multi_choice", **options
    )


def learn(policy: MMEPolicy, optimizer: torch.optim.Optimizer, rows: Batch, updates: int) -> None:
    policy.train()
    for update in range(updates):
        batch = rows.rows(torch.randint(len(rows.prompt), (24,)))
        noisy = batch.history.features + NOISE * torch.randn_like(batch.history.features)
        loss, _ = policy(replace(batch, history=replace(batch.history, features=noisy)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if update in (0, updates - 1):
            print(f"loss {loss:.2f}")
    policy.eval()


def main(
    output: str = "outputs/dagger", scenes: tuple[int, ...] = (180, 40, 24), updates: int = 900
) -> None:
    """Print success in new scenes and the loss after each round; in the first round the oracle
    acts.
    """
    policy = build_policy(
        "framesamp_modul", backbone="nano_choice", embodiment="robomme_choice_front", seed=0,
        memory={"budget": 4, "grid": 1, "every": 8}, policy={"augment": False},
        **{"backbone.head.temperature": 0},  # the best option, without noise
    )  # fmt: skip
    policy.backbone.vision.requires_grad_(False)
    policy.require_processor().stats = NormStats.unit(8, 10, POINTS)
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], 1e-3)
    torch.manual_seed(0)
    data: list[Batch] = []
    for step, count in enumerate(scenes):
        jobs = [Job("VideoUnmask", "train", sum(scenes[:step]) + i) for i in range(count)]
        trajectories = list(
            rollouts(policy, make_easy_env, jobs, ["oracle"], oracle_share=step == 0, max_steps=400)
        )
        print(f"round {step}: success {sum(t.success for t in trajectories) / count:.2f}")
        data += [t.oracle for t in trajectories if t.oracle is not None]
        if step < len(scenes) - 1:
            learn(policy, optimizer, with_view_tokens(policy, join(data)), updates)
    policy.save_pretrained(output)


if __name__ == "__main__":
    main()
