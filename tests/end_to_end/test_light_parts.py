"""Single parts need few packages: a policy without LeRobot, Hydra and pandas, a client without
torch.
"""

import subprocess
import sys

import pytest

from helpers import REPOSITORY
from helpers.installed import modules_beyond, without_modules
from helpers.serving_fakes import Served, serving_policy
from mme_vla.testing.small import tiny_sections

pytestmark = pytest.mark.slow

NETWORK = {"torch", "numpy", "einops", "timm", "pillow", "safetensors", "sentencepiece"}
CHECKED = {"pydantic", "omegaconf", "filelock"}  # sections are read, files are locked
POLICY = """
import tempfile
import numpy as np
import torch
from mme_vla import MMEPolicy, build_policy
from mme_vla.model import MMEModel
from mme_vla.testing.small import random_batch, unit_stats

loaded = MMEPolicy.from_pretrained(NANO)
episode = loaded.start_episode("pick up the red cube", seed=7)
frame = np.full((1, 256, 256, 3), 127, np.uint8)
episode.observe({"front": frame, "wrist": frame}, np.zeros((1, 8), np.float32))
chunk = loaded.act(episode)
assert np.isfinite(chunk).all()

policy = MMEPolicy.from_config(SECTIONS)
assert isinstance(policy.model, MMEModel)
batch = random_batch(policy)
loss, _ = policy(batch)
loss.backward()
noise = policy.model.sampling_noise(torch.Generator())
sampled = policy.model.eval().sample(
    batch, {name: torch.stack([value, value]) for name, value in noise.items()}
)
with tempfile.TemporaryDirectory() as folder:
    loaded.save_pretrained(folder, card={"data": "none"})
    again = MMEPolicy.from_pretrained(folder)
    for name, value in loaded.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
try:
    build_policy("framesamp_modul", backbone="tiny")
except ImportError as error:
    print("by name:", error)
print("done", float(loss), tuple(sampled.shape))
"""
CLIENT = """
import importlib.util, sys
assert importlib.util.find_spec("torch") is None
import numpy as np
from mme_vla.serving.client import Client

with Client(URL) as client:
    client.reset()
    frame = np.full((2, 256, 256, 3), 127, np.uint8)
    state = np.zeros((2, 8), np.float32)
    client.add_buffer(frame, state, 1)
    reply = client.infer(
        {"observation/image": frame[-1], "observation/wrist_image": frame[-1],
         "observation/state": state[-1], "prompt": "press the button"}
    )
print("done", reply["actions"].shape)
"""


def run(code: str, packages: set[str]) -> str:
    """What a program prints where only these packages, and those that they require, are found."""
    hidden = modules_beyond(packages, deep=True)
    process = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code],
        env=without_modules(hidden), capture_output=True, text=True,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr[-3000:]
    return process.stdout


def test_a_policy_runs_without_lerobot_hydra_and_pandas() -> None:
    sections = tiny_sections("framesamp_modul")
    nano = REPOSITORY / "mme_vla" / "assets" / "nano"
    code = f"NANO, SECTIONS = {str(nano)!r}, {sections!r}\n{POLICY}"
    printed = run(code, NETWORK | CHECKED)
    assert printed.startswith("by name:") and "done" in printed


def test_a_client_runs_without_torch() -> None:
    pytest.importorskip("websockets", reason="needs the server: uv sync --inexact --extra serve")
    with Served(serving_policy("framesamp_modul")) as served:
        host, port = served.address
        printed = run(
            f"URL = 'ws://{host}:{port}'\n{CLIENT}",
            {"numpy", "pillow", "pydantic", "msgpack", "websockets"},
        )
    assert "done (20, 8)" in printed
