"""Samples per second of the training dataset with its cache, and resident memory as the dataset
grows.

    python benchmarks/dataset.py [--model tokendrop_expert] [--copies 1 4 16] [--items 600]

The embedded sample is copied side by side into one larger LeRobot dataset; each size has a process
of its own.
"""

import argparse
import multiprocessing
import tempfile
import time
from pathlib import Path

import numpy as np
from timing import machine


def grow(copies: int, folder: Path) -> Path:
    """A dataset of `copies` times the sample's episodes."""
    from lerobot.datasets.aggregate import aggregate_datasets

    from mme_vla.data.lerobot_files import SAMPLE

    if copies == 1:
        return SAMPLE
    target = folder / f"grown{copies}"
    aggregate_datasets(
        repo_ids=[f"local/{i}" for i in range(copies)],
        aggr_repo_id=f"local/{target.name}",
        roots=[SAMPLE] * copies,
        aggr_root=target,
    )
    return target


def resident_mib() -> tuple[float, float]:
    """Anonymous and file-backed resident memory of this process."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return tuple(int(lines[key].split()[0]) / 1024 for key in ("RssAnon", "RssFile"))


def measure(root: Path, model: str, items: int, caches: Path) -> tuple[int, float, float, float]:
    """Frames, samples per second, anonymous and file-backed MiB after reading `items` random
    samples.
    """
    import torch

    from mme_vla import build_policy
    from mme_vla.data.cache_building import ensure_cache
    from mme_vla.data.dataset import TrainingDataset
    from mme_vla.data.episodes import EpisodeSource
    from mme_vla.data.statistics import compute_norm_stats

    torch.set_num_threads(2)
    policy, source = build_policy(model), EpisodeSource(root)
    policy.processor.stats = compute_norm_stats([source])
    cache = ensure_cache(
        source,
        policy.memory,
        policy.encode_frames,
        policy.vision_fingerprint(),
        root=caches,
        max_build_frames=10**6,
    )
    data = TrainingDataset([source], policy.processor, policy.memory, [cache])
    order = np.random.default_rng(0).permutation(len(data))[:items]
    for index in order[:20]:
        data[int(index)]
    start = time.perf_counter()
    for index in order:
        data[int(index)]
    return int(source.lengths.sum()), len(order) / (time.perf_counter() - start), *resident_mib()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--model", default="tokendrop_expert")
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 4, 16])
    parser.add_argument("--items", type=int, default=400)
    args = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for copies in args.copies:
            root = grow(copies, Path(folder))
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                rows.append(
                    (
                        copies,
                        *pool.apply(
                            measure, (root, args.model, args.items, Path(folder) / "caches")
                        ),
                    )
                )
    print(f"{machine()}; {args.model}, in the main process, {args.items} random samples")
    print(
        "| dataset | frames | samples/s | anonymous memory | file-backed, shared"
        " |\n|---|---:|---:|---:|---:|"
    )
    for copies, frames, rate, anonymous, mapped in rows:
        print(f"| {copies}x | {frames:,} | {rate:.0f} | {anonymous:.0f} MiB | {mapped:.0f} MiB |")


if __name__ == "__main__":
    main()
