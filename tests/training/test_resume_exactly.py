"""A run that continues from a checkpoint has the checkpoints of one that never stopped, to the last
bit.
"""

import shutil
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from mme_vla.cli.train import main
from mme_vla.config.composition import compose
from mme_vla.policy.tensor_files import assign_tensors, load_tensors, take_memory

WORDS = [
    "model=ttt_modul",
    "backbone.depth=1",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=32",
    "backbone.vision.patch_size=2",
    "memory.budget=64",
    "memory.max_steps=3",
    "memory.max_video=2",
    "memory.chunk=2",
    "train.steps=4",
    "train.save_every=1",
    "train.val_every=2",
    "train.val_samples=1",
    "train.batch_size=1",
    "train.open_loop_chunks=0",
    "train.device=cpu",
    "train.workers=0",
    "train.keep.last=3",
    "logger=none",
    "resume=auto",
]


def test_checkpoints_after_resuming_are_equal_to_the_last_bit(tmp_path: Path) -> None:
    run, straight = tmp_path / "run", tmp_path / "whole"
    words = [*WORDS, f"data.cache.root={tmp_path}", f"output={run}"]
    main(compose("train", words))
    shutil.copytree(run, straight)
    for step in (3, 4):
        shutil.rmtree(run / "checkpoints" / f"step_{step:06d}")
    main(compose("train", words))
    # No validation lies between the second and the third: its loss stays in the card.
    for step in (3, 4):
        checkpoint = Path("checkpoints") / f"step_{step:06d}"
        files = sorted(path.name for path in (straight / checkpoint).iterdir())
        assert files == sorted(path.name for path in (run / checkpoint).iterdir())
        for name in files:
            equal = (run / checkpoint / name).read_bytes() == (
                straight / checkpoint / name
            ).read_bytes()
            assert equal, f"{checkpoint}/{name}"


def test_tensors_of_a_file_get_memory_that_torch_allots(tmp_path: Path) -> None:
    save_file({"weight": torch.randn(3, 5), "bias": torch.randn(3)}, tmp_path / "model.safetensors")
    layer, stored = nn.Linear(5, 3), load_file(tmp_path / "model.safetensors")
    assign_tensors(layer, load_tensors(tmp_path), "here")
    if not any(p.data_ptr() % 64 for p in layer.parameters()):
        pytest.skip("this safetensors aligns what it reads")
    take_memory(layer)
    assert all(p.data_ptr() % 64 == 0 for p in layer.parameters())
    assert all(torch.equal(p, stored[name]) for name, p in layer.named_parameters())
