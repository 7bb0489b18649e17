"""Checkpoints of every model; their weights follow from the names of the tensors, so that an
archive is small.
"""

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

import mme_vla
from mme_vla.testing import random_batch
from mme_vla.testing.small import random_history

HEAD, KEPT, NAMES = "model.safetensors.head", "model.safetensors.kept", "kept.json"
PI05: dict[str, Any] = {
    "backbone.vision": {
        "image_size": 16,
        "patch_size": 1,
        "depth": 1,
        "width": 8,
        "mlp_dim": 8,
        "num_heads": 1,
    },
    "backbone.vlm": {"width": 8, "mlp_dim": 8},
    "backbone.action": {"width": 8, "mlp_dim": 8},
    "backbone.depth": 1,
    "backbone.num_heads": 1,
    "backbone.head_dim": 8,
    "backbone.action_dim": 8,
    "backbone.vocab_size": 1024,
}
TOWERS = {
    name: {"width": 8, "depth": 2, "mlp_dim": 16, "num_heads": 1} for name in ("dino", "siglip")
}
TWO_TOWERS: dict[str, Any] = {
    "backbone.vision": {"image_size": 56, "patch_size": 7, **TOWERS},
    "backbone.vlm": {"depth": 1, "width": 16, "mlp_dim": 16, "num_heads": 1},
    "backbone.vocab_size": 1024,
}
SIZES: dict[str, dict[str, Any]] = {
    "diffusion_policy": {},
    "sam2act": {},
    "simplememvla": {},
    "openvla": TWO_TOWERS,
    "memoryvla": {
        **TWO_TOWERS,
        "backbone.perceptual_width": 8,
        "backbone.compression_width": 8,
        "backbone.head": {"width": 16, "depth": 1, "num_heads": 1},
    },
    "spacetime": {**PI05, "memory.state_dim": 8},
    "actions": {
        **PI05,
        "backbone.vlm": {"width": 24, "mlp_dim": 8},
    },  # carries 17 numbers of the robot
}
"""Beginning of a model's name → its smallest sizes; `PI05` for the others."""


def sizes_of(model: str) -> dict[str, Any]:
    """The settings that make a model small."""
    return next((sizes for start, sizes in SIZES.items() if model.startswith(start)), PI05)


def words(settings: Mapping[str, Any], prefix: str = "") -> list[str]:
    """Settings as words of a command line."""
    arguments: list[str] = []
    for key, value in settings.items():
        arguments += (
            words(value, f"{prefix}{key}.")
            if isinstance(value, Mapping)
            else [f"{prefix}{key}={value}"]
        )
    return arguments


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as keywords of `build_policy`: dotted keys become mappings."""
    sections: dict[str, Any] = {}
    for key, value in settings.items():
        section, _, name = key.partition(".")
        sections.setdefault(section, {})[name] = value
    return sections


def uniform(name: str, shape: Sequence[int]) -> np.ndarray:
    """Float32 numbers in [-1, 1) that follow from a name (splitmix64 of whole numbers: no library's
    generator).
    """
    with np.errstate(over="ignore"):
        z = np.arange(int(np.prod(shape, dtype=np.int64)), dtype=np.uint64)
        z += np.uint64(zlib.crc32(name.encode()) << 32)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
            z = (z + np.uint64(0x9E3779B97F4A7C15) ^ z >> np.uint64(shift)) * np.uint64(factor)
    return ((z >> np.uint64(40)).astype(np.float32) / np.float32(2**23) - np.float32(1)).reshape(
        shape
    )


def weight(name: str, shape: Sequence[int]) -> np.ndarray:
    """A parameter by rule: small biases, scales about one, matrices of unit gain. No
    gate is shut.
    """
    values = uniform(name, shape)
    if not values.size:
        return values
    if name.endswith("bias"):
        return np.float32(0.1) * values
    if len(shape) < 2:
        return np.float32(1) + np.float32(0.2) * values
    return values * np.float32(np.sqrt(3 / np.prod(shape[1:])))


def read_head(data: bytes) -> tuple[bytes, dict[str, Any]]:
    """The header of a safetensors file with its length in front, and what it says of each tensor in
    order of place.
    """
    end = 8 + int.from_bytes(data[:8], "little")
    tensors = {
        name: value for name, value in json.loads(data[8:end]).items() if name != "__metadata__"
    }
    return data[:end], dict(sorted(tensors.items(), key=lambda item: item[1]["data_offsets"]))


def build(model: str, folder: Path, scratch: Path) -> None:
    """Save a small policy of a model whose parameters are `weight`s."""
    from mme_vla.testing.small import unit_stats

    policy = mme_vla.build_policy(model, **nested(sizes_of(model)))
    policy.require_processor().stats = unit_stats(policy.embodiment)
    policy.save_pretrained(scratch)
    buffers = {name for name, _ in policy.named_buffers()}
    tensors = load_file(scratch / "model.safetensors")
    for name, tensor in tensors.items():
        if tensor.dtype == torch.float32 and name not in buffers:
            tensors[name] = torch.from_numpy(np.ascontiguousarray(weight(name, tensor.shape)))
    save_file(tensors, scratch / "model.safetensors", metadata={"format": "pt"})
    (scratch / "SHA256SUMS").unlink()
    mme_vla.Policy.from_pretrained(scratch).save_pretrained(folder)


def strip(folder: Path) -> None:
    """Replace a saved policy's weights by the file's header and the tensors that are
    not `weight`s.
    """
    file = folder / "model.safetensors"
    data = file.read_bytes()
    head, tensors = read_head(data)
    kept, names = b"", []
    for name, tensor in tensors.items():
        begin, end = (len(head) + place for place in tensor["data_offsets"])
        if tensor["dtype"] != "F32" or weight(name, tensor["shape"]).tobytes() != data[begin:end]:
            kept += data[begin:end]
            names.append(name)
    (folder / HEAD).write_bytes(head)
    (folder / KEPT).write_bytes(kept)
    (folder / NAMES).write_text(json.dumps(names))
    file.unlink()


def restore(folder: Path) -> None:
    """Write the weights that `strip` removed, byte for byte: `SHA256SUMS` holds for them."""
    head, tensors = read_head((folder / HEAD).read_bytes())
    kept, names = (folder / KEPT).read_bytes(), set(json.loads((folder / NAMES).read_text()))
    with (folder / "model.safetensors").open("wb") as file:
        file.write(head)
        for name, tensor in tensors.items():
            if name in names:
                begin, end = tensor["data_offsets"]
                file.write(kept[: end - begin])
                kept = kept[end - begin :]
            else:
                file.write(weight(name, tensor["shape"]).tobytes())
    for name in (HEAD, KEPT, NAMES):
        (folder / name).unlink()


def episode_of(policy: Any, shift: int = 0) -> Any:
    """An episode after a short conditioning video and four frames of execution; `shift` changes the
    video's images.
    """
    rng = np.random.default_rng(5)
    depth = policy.config["name"].startswith("sam2act")
    episode = policy.start_episode("press the button", seed=3)
    episode.subgoal = "press the button at <10, 20>"
    down = np.array([[0, -1, 0, 0.0], [-1, 0, 0, 0.0], [0, 0, -1, 1.0]], np.float32)
    for count in (9, 4):
        frames: dict[str, np.ndarray] = {}
        for camera in policy.embodiment.cameras:
            name = camera if isinstance(camera, str) else camera.name
            frames[name] = rng.integers(0, 256, (count, 64, 64, 3), dtype=np.uint8)
            if count == 9:
                frames[name] += np.uint8(shift)
            if depth:
                frames[f"{name}_depth"] = rng.integers(400, 1000, (count, 64, 64, 1)).astype(
                    np.int16
                )
                frames[f"{name}_camera_extrinsic"] = np.tile(down, (count, 1, 1))
        state = rng.normal(size=(count, policy.embodiment.state.width)).astype(np.float32) * (
            0.1 if depth else 1
        )
        episode.observe(
            frames, state, is_demo=np.arange(count) < count - 1 if count == 9 else False
        )
    return episode


def loss_of(policy: Any) -> float:
    """The loss of one small batch of noise; policies whose batches hold what only a dataset has
    raise an error.
    """
    generator = torch.Generator().manual_seed(11)
    if type(policy) is mme_vla.MMEPolicy:
        batch: Any = random_batch(policy, batch=2, valid=32)
    else:
        batch = policy.observation([episode_of(policy)])
        shape = (1, policy.horizon, policy.embodiment.action.width)
        batch = replace(batch, actions=torch.randn(shape, generator=generator))
        if getattr(policy, "memory", None) is not None:
            batch = replace(batch, history=random_history(policy, batch=1, valid=32))
    with torch.no_grad():
        return float(policy(batch, policy.training_noise(len(batch.actions), generator))[0])


def figures(policy: Any) -> dict[str, Any]:
    """What a policy gives: the loss of a batch, and the first of the actions after an episode's
    frames.
    """
    try:
        loss = loss_of(policy)
    except (TypeError, ValueError, IndexError):  # the batch is none of this policy's
        loss = None
    actions = np.asarray(policy.act([episode_of(policy)])[0], np.float64)
    return {
        "loss": None if loss is None else float(f"{loss:.8g}"),
        "actions": [[float(f"{value:.8g}") for value in row] for row in actions],
    }
