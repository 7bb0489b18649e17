"""What parts of the library import besides themselves."""

import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

WITHOUT = {
    "the package": (
        [
            "lerobot",
            "hydra",
            "timm",
            "transformers",
            "h5py",
            "matplotlib",
            "accelerate",
            "tensorboard",
            "PIL",
        ],
        (
            "import mme_vla\nfrom mme_vla import HistoryTokens, MemoryTokens, Batch, UserError,"
            " MEMORIES, INTEGRATIONS, BACKBONES\nfrom mme_vla import Memory, History, StorageSpec,"
            " OnlineHistory, CachedHistory"
        ),
    ),
    "the policy": (
        [
            "lerobot",
            "hydra",
            "transformers",
            "h5py",
            "matplotlib",
            "accelerate",
            "tensorboard",
            "mani_skill",
        ],
        "from mme_vla import MMEPolicy, Episode",
    ),
    "subgoals": (
        ["transformers", "peft", "google", "av", "lerobot", "hydra"],
        (
            "from mme_vla.subgoal import build_predictor\nassert build_predictor({'name':"
            " 'oracle'}).kind == 'grounded'"
        ),
    ),
    "training": (
        [],
        (
            "import sys, mme_vla; from mme_vla import Policy, build_policy; import"
            " mme_vla.training.loop\nassert not {'diffusers', 'torchvision', 'transformers',"
            " 'torch._dynamo'} & set(sys.modules), 'there, but not needed'"
        ),
    ),
    "environments": (
        [],
        (
            "import sys, mme_vla.envs as e; e.make_env, e.episode\nassert 'mani_skill' not in"
            " sys.modules"
        ),
    ),
}
"""Packages that cannot be imported, and what works without them."""

TRY = "import sys\nsys.modules.update(dict.fromkeys({!r}))  # importing them raises ImportError\n{}"


@pytest.mark.slow
@pytest.mark.parametrize("what", WITHOUT)
def test_it_is_imported_without_what_it_does_not_need(what: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", TRY.format(*WITHOUT[what])],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
    )
    assert done.returncode == 0, done.stderr
