"""The rows of `gpu.py` about training: an update by one process or by many, and how long it waits
for data.
"""

import statistics
import tempfile
import time
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from gpu_setup import (
    Setup,
    batch_of,
    built,
    draws_of,
    milliseconds,
    peak_flops,
    peak_gib,
    sample_flops,
    wait,
)
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

from mme_vla import MMEPolicy
from mme_vla.training.optim import EMA, WeightUpdate, make_optimizer
from mme_vla.training.parallel import reshard, shard
from mme_vla.training.settings import ParallelSettings, TrainSettings
from mme_vla.types import Batch


def updating(
    policy: MMEPolicy, setup: Setup, strategy: str | None = None
) -> tuple[Callable[[Batch, dict[str, Tensor]], None], list[Tensor]]:
    """An update of one model as the trainer makes it (forward, backward, clipping, AdamW, EMA), and
    its losses so far.

    Args:
        strategy: how processes share it: `ddp` (each has all weights) or `fsdp` (each a part); None
            for one process.
    """
    if setup.compiled:
        policy.compile()
    model: nn.Module = policy
    if strategy == "fsdp":
        shard(
            policy,
            ParallelSettings("fsdp").mesh(setup.device.type),
            policy.compute_dtype,
            setup.compiled,
        )
    elif strategy == "ddp":
        model = DistributedDataParallel(policy, gradient_as_bucket_view=True)
    learning = {name: p for name, p in policy.named_parameters() if p.requires_grad}
    optimizer = make_optimizer(
        learning.values(), TrainSettings(steps=1, batch_size=setup.batch, lr=1e-5)
    )
    ema = EMA(learning, 0.999, reshard=partial(reshard, policy))
    one_pass = setup.compiled and setup.device.type == "cuda" and strategy != "fsdp"
    update_weights = WeightUpdate(learning, optimizer, ema, 1.0, one_pass)
    losses: list[Tensor] = []

    def update(batch: Batch, draws: dict[str, Tensor]) -> None:
        loss, _ = model(batch, draws)
        loss.backward()
        update_weights(len(losses))
        losses.append(loss.detach())

    return update, losses


def training(model: str, setup: Setup, strategy: str | None = None) -> dict[str, Any]:
    """An update of one model, and what of each GPU it uses."""
    device = setup.device
    policy = built(model, setup.backbone, device, setup.attention)
    update, losses = updating(policy, setup, strategy)
    batch, draws = batch_of(policy, setup.batch, device), draws_of(policy, setup.batch, device)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    took = milliseconds(lambda: update(batch, draws), setup.rounds, 3, device)
    median, peak = statistics.median(took), peak_flops(device)
    needed, computed = sample_flops(model, setup.backbone)
    per_flop = None if peak is None else setup.batch / (median / 1e3) / peak
    return {
        "ms": median, "samples_per_s": 1e3 * setup.batch * setup.processes / median,
        "tflop_per_sample": needed / 1e12,
        "mfu": None if per_flop is None else needed * per_flop,
        "hfu": None if per_flop is None else computed * per_flop,
        "peak_gib": peak_gib(device),
        "finite": bool(torch.isfinite(torch.stack(losses)).all()),
    }  # fmt: skip


def feeding(model: str, setup: Setup, workers: int) -> dict[str, float]:
    """Updates from the embedded demonstrations, read by `workers` processes: the share of time that
    waits for them.
    """
    policy, device = built(model, setup.backbone, setup.device, setup.attention), setup.device
    with tempfile.TemporaryDirectory() as folder:
        batches = _batches(policy, setup, workers, Path(folder))
        update, _ = updating(policy, setup)
        draws = draws_of(policy, setup.batch, device)
        for _ in range(2):
            update(next(batches).to(device, non_blocking=True), draws)
        wait(device)
        waited, begun = 0.0, time.perf_counter()
        for _ in range(setup.rounds):
            request_time = time.perf_counter()
            batch = next(batches)
            waited += time.perf_counter() - request_time
            update(batch.to(device, non_blocking=True), draws)
        wait(device)
        took = time.perf_counter() - begun
        batches.close()
    return {
        "workers": workers,
        "waiting": waited / took,
        "samples_per_s": setup.rounds * setup.batch / took,
    }


def _batches(
    policy: MMEPolicy, setup: Setup, workers: int, caches: Path
) -> Generator[Batch, None, None]:
    """Batches of the embedded demonstrations in random order, without end."""
    from mme_vla.data.cache_building import ensure_cache
    from mme_vla.data.dataset import TrainingDataset
    from mme_vla.data.episodes import EpisodeSource
    from mme_vla.data.lerobot_files import SAMPLE
    from mme_vla.data.statistics import compute_norm_stats

    source, processor = EpisodeSource(SAMPLE), policy.require_processor()
    processor.stats = compute_norm_stats([source])
    cache = None
    if policy.memory is not None:
        fingerprint = policy.vision_fingerprint()
        cache = [
            ensure_cache(source, policy.memory, policy.encode_frames, fingerprint, root=caches)
        ]
    data = TrainingDataset([source], processor, policy.memory, cache)
    endless = torch.utils.data.RandomSampler(
        data, replacement=True, num_samples=setup.batch * (setup.rounds + 64)
    )
    loader = DataLoader(
        data,
        setup.batch,
        sampler=endless,
        collate_fn=processor.collate,
        num_workers=workers,
        drop_last=True,
        pin_memory=setup.device.type == "cuda",
        prefetch_factor=4 if workers else None,
    )
    yield from loader
