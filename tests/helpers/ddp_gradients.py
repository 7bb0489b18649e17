"""One of two processes that wrap a model: `torchrun … ddp_gradients.py KIND FOLDER` saves this
one's gradients.

KIND: `ddp`, or `fsdp` (`fully_shard`), each called as PyTorch's documentation does.
"""

import sys
from pathlib import Path

import torch
from torch import distributed
from torch.distributed.fsdp import fully_shard
from torch.nn.parallel import DistributedDataParallel

from mme_vla.model import MMEModel
from mme_vla.testing.small import SMALL_VISION, open_gates, random_batch, small_policy


def main(kind: str, folder: Path) -> None:
    distributed.init_process_group("gloo")
    rank = distributed.get_rank()
    policy = small_policy("framesamp_modul", backbone={"vision": SMALL_VISION})
    open_gates(policy)
    model = MMEModel(policy.backbone, policy.memory, policy.integration)
    wrapped = DistributedDataParallel(model) if kind == "ddp" else fully_shard(model)
    batch = random_batch(policy, seed=rank)  # each process has samples of its own
    noise = model.training_noise(len(batch.prompt), torch.Generator().manual_seed(rank))
    wrapped(batch, noise).backward()
    gradient = next(
        p.grad for name, p in model.named_parameters() if name.endswith("action_out.weight")
    )
    gradient = gradient.full_tensor() if kind == "fsdp" else gradient
    torch.save(gradient, folder / f"{rank}.pt")
    distributed.destroy_process_group()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
