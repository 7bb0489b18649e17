"""What parts of the library import besides themselves.

All is tried in forks of one process that has imported PyTorch and einops and nothing else, as each would import them.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

WITHOUT = {
    "the package": (
        ["lerobot", "hydra", "timm", "transformers", "h5py", "matplotlib", "accelerate", "tensorboard", "PIL"],
        "import mme_vla\n"
        "from mme_vla import HistoryTokens, MemoryTokens, Batch, UserError, MEMORIES, INTEGRATIONS, BACKBONES\n"
        "from mme_vla import Memory, History, StorageSpec, OnlineHistory, CachedHistory",
    ),
    "the policy": (
        ["lerobot", "hydra", "transformers", "h5py", "matplotlib", "accelerate", "tensorboard", "mani_skill"],
        "from mme_vla import MMEPolicy, Episode",
    ),
    "subgoals": (
        ["transformers", "peft", "google", "av", "lerobot", "hydra"],
        "from mme_vla.subgoal import build_predictor\nassert build_predictor({'name': 'oracle'}).kind == 'grounded'",
    ),
    "training": (
        [],
        "import sys, mme_vla; from mme_vla import Policy, build_policy; import mme_vla.training.loop\n"
        "assert not {'diffusers', 'torchvision', 'transformers'} & set(sys.modules), 'there, but not needed'",
    ),
    "environments": (
        [],
        "import sys, mme_vla.envs as e; e.make_env, e.episodes\nassert 'mani_skill' not in sys.modules",
    ),
}
"""Packages that cannot be imported, and what works without them."""

TRY = """
import json, os, sys, tempfile, traceback
import einops, torch
said = {}
for what, (absent, code) in json.load(sys.stdin).items():
    with tempfile.TemporaryFile("w+") as printed:
        if (child := os.fork()) == 0:
            try:
                sys.modules.update(dict.fromkeys(absent))  # importing them raises ImportError
                exec(code, {"__name__": "__main__"})
            except BaseException:
                traceback.print_exc(file=printed)
            printed.flush()
            os._exit(0)
        status = os.waitpid(child, 0)[1]
        printed.seek(0)
        said[what] = printed.read() or (f"killed: status {status}" if status else "")
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def reports() -> dict[str, str]:
    """How each of them failed; empty where it did not."""
    done = subprocess.run(
        [sys.executable, "-c", TRY], input=json.dumps(WITHOUT), capture_output=True, text=True, cwd=REPOSITORY
    )
    assert done.returncode == 0, done.stderr
    answers: dict[str, str] = json.loads(done.stdout)
    return answers


@pytest.mark.slow
@pytest.mark.parametrize("what", WITHOUT)
def test_it_is_imported_without_what_it_does_not_need(reports: dict[str, str], what: str) -> None:
    assert reports[what] == ""
