"""One of two processes that train together behind LeRobot's interface:
`python lerobot_two_processes.py <folder>`.

Opens the dataset as a first update does, and writes down how often it built a cache and what its
first batch holds.
"""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import distributed

from helpers.plugins import plugin
from mme_vla.data import cache_building
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.testing.small import SMALL_VISION, small_policy


def main(folder: Path) -> None:
    distributed.init_process_group("gloo")
    build, built = cache_building.build_cache, 0

    def counting(*args: Any, **options: Any) -> Any:
        nonlocal built
        built += 1
        return build(*args, **options)

    cache_building.build_cache = counting  # type: ignore[assignment]
    policy = small_policy("tokendrop_modul", backbone={"vision": SMALL_VISION})
    config = SimpleNamespace(
        model="tokendrop_modul",
        exec_starts=None,
        cache_root=str(folder / "caches"),
        cache_local=False,
        max_build_frames=5000,
        seed=1,
    )
    with plugin("lerobot_policy_mme_vla", "lerobot_policy_mme_vla"):
        from lerobot_policy_mme_vla.samples import Samples

        samples = Samples(policy, config, SimpleNamespace(root=SAMPLE, repo_id="local/sample"))  # type: ignore[arg-type]
        batch = samples.batch(torch.tensor([900]))
    report = {"built": built, "sum": float(batch.history.features.float().sum())}
    (folder / f"{distributed.get_rank()}.json").write_text(json.dumps(report))
    distributed.destroy_process_group()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
