"""Pretraining of the nano backbone's vision tower: which object is where, and what colour things have.

The tower says, for each of the 8×8 places under a token, which class of objects is seen there (the labels of
`scenes.py`), and gives back a coarse image.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone.nano import NanoBackbone, NanoConfig
from mme_vla.backbone.nano_vision import CLASSES, COARSE, FINE, WORDS, ConvTower
from mme_vla.config.sections import read_section
from mme_vla.errors import require
from mme_vla.nano.scenes import LABEL_SIDE
from mme_vla.processing.images import to_unit_range
from mme_vla.processing.tokenizer import SAMPLE, Tokenizer
from mme_vla.utils import write_atomically
from mme_vla.weights.torch_files import load_torch_file

logger = logging.getLogger(__name__)
SHIFT = 8  # pixels that an image is moved by at most
NAMED = {"red": "red cube", "green": "green cube", "blue": "blue cube"}
"""Words of goals, and the class of objects that each names."""


@dataclass(frozen=True)
class PretrainSettings:
    """steps: updates. batch_size: images each. lr: peak learning rate, on a cosine to zero after a short warm-up.

    held_out: share of the scenes that only measure. save_every: updates between two drafts. seed: of everything random.
    """

    steps: int = 800
    batch_size: int = 32
    lr: float = 2e-3
    held_out: float = 0.1
    save_every: int = 200
    seed: int = 0


def as_images(tower: ConvTower, images: Tensor, grid: int) -> tuple[Tensor, Tensor]:
    """What a tower says of images [n, 3, s, s]: class scores [n, classes, 64, 64] and colours [n, 3, 32, 32]."""
    scores, colours = tower.answers(images)
    return _joined(scores, grid, FINE), _joined(colours.unflatten(-1, (3, -1)), grid, COARSE)


def _joined(x: Tensor, grid: int, side: int) -> Tensor:
    """[n, grid², c, side²] → [n, c, grid·side, grid·side]."""
    x = x.unflatten(-1, (side, side)).unflatten(1, (grid, grid))  # n y x c i j
    return x.permute(0, 3, 1, 4, 2, 5).flatten(4, 5).flatten(2, 3)


def fresh_tower(sizes: Mapping[str, Any], width: int) -> tuple[ConvTower, int]:
    """A tower with random weights, and the side of its token grid.

    sizes: the section `backbone.vision`. width: of a token.
    """
    section = {"vision": {**sizes, "pretrained": False}, "vlm": {"width": width, "mlp_dim": width}}
    backbone = NanoBackbone(read_section(NanoConfig, section, "backbone"))
    backbone.vision.words.copy_(class_words())
    return backbone.vision, backbone.grid


def class_words() -> Tensor:
    """Which word of the shipped tokenizer names which class of objects: [words, classes but the first], 0 or 1."""
    tokenizer = Tokenizer.load(SAMPLE)
    table = torch.zeros(WORDS, len(CLASSES) - 1)
    for word, name in NAMED.items():
        table[tokenizer.piece(f"▁{word}"), CLASSES.index(name) - 1] = 1
    return table


def load_scenes(files: Sequence[Path]) -> tuple[Tensor, Tensor]:
    """Images [n, 3, s, s] uint8 and labels [n, 64, 64] uint8 of recorded scenes."""
    require(files, "There is no recorded scene to learn from.")
    images, labels = [], []
    for file in files:
        with np.load(file) as scene:
            images.append(torch.from_numpy(scene["pictures"]).permute(0, 3, 1, 2))
            labels.append(torch.from_numpy(scene["labels"]))
    return torch.cat(images), torch.cat(labels)


def shifted(images: Tensor, labels: Tensor, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """All moved by the same few pixels, the edges repeated."""
    ratio = images.shape[-1] // LABEL_SIDE
    down, right = (int(n) for n in rng.integers(-SHIFT // ratio, SHIFT // ratio + 1, 2))
    most = SHIFT // ratio
    label = functional.pad(labels[:, None].float(), (most,) * 4, mode="replicate")[:, 0]
    label = label[:, most + down : most + down + LABEL_SIDE, most + right : most + right + LABEL_SIDE].long()
    padded = functional.pad(images, (SHIFT,) * 4, mode="replicate")
    top, left, side = SHIFT + down * ratio, SHIFT + right * ratio, images.shape[-1]
    return padded[..., top : top + side, left : left + side], label


def tower_loss(tower: ConvTower, grid: int, images: Tensor, labels: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """The training loss of a batch, and the share [classes] of each class's places that are named rightly."""
    scores, colours = as_images(tower, images, grid)
    loss = functional.cross_entropy(scores, labels, weights)
    loss = loss + functional.l1_loss(colours, functional.interpolate(images, grid * COARSE, mode="area"))
    right = scores.argmax(1) == labels
    share = [right[labels == number].float().mean() for number in range(len(CLASSES))]
    return loss, torch.stack(share).detach()


def pretrain(tower: ConvTower, grid: int, files: Sequence[Path], folder: Path, settings: PretrainSettings) -> Path:
    """Train a tower on recorded scenes; a run that was interrupted continues. The path of its weights.

    tower: with fresh weights. grid: side of its token grid. files: scenes. folder: of the run.
    """
    from safetensors.torch import save_file

    weights_file, draft = folder / "nano_vision.safetensors", folder / "draft.pt"
    if weights_file.is_file():
        return weights_file
    folder.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(settings.seed)
    shuffled = [files[i] for i in np.random.default_rng(settings.seed).permutation(len(files))]
    n_val = max(1, round(settings.held_out * len(files)))
    val_images, val_labels = load_scenes(shuffled[:n_val])
    images, labels = load_scenes(shuffled[n_val:])
    weights = _class_weights(labels)
    tower.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in the stubs
    optimizer = torch.optim.AdamW(tower.parameters(), lr=settings.lr, weight_decay=0.01)
    start = 0
    if draft.is_file():
        state = load_torch_file(draft, "the draft of a vision tower")
        tower.load_state_dict(state["tower"])
        optimizer.load_state_dict(state["optimizer"])
        start = state["step"]
    for step in range(start, settings.steps):
        rng = np.random.default_rng([settings.seed, step])
        rows = torch.from_numpy(rng.integers(0, len(images), settings.batch_size))
        for group in optimizer.param_groups:
            group["lr"] = settings.lr * min(1, (step + 1) / 50) * (1 + math.cos(math.pi * step / settings.steps)) / 2
        loss, _ = tower_loss(tower, grid, *shifted(to_unit_range(images[rows]), labels[rows], rng), weights)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(tower.parameters(), 1.0)
        optimizer.step()
        done = step + 1
        if done % settings.save_every == 0 or done == settings.steps:
            with write_atomically(draft) as path:
                torch.save({"tower": tower.state_dict(), "optimizer": optimizer.state_dict(), "step": done}, path)
            logger.info("step %d/%d · loss %.4f · %s", done, settings.steps, loss.item(),
                        report(tower, grid, val_images, val_labels, weights))  # fmt: skip
    state = {name: value.contiguous().half() for name, value in tower.state_dict().items()}
    with write_atomically(weights_file) as path:
        save_file(state, path)
    return weights_file


@torch.no_grad()
def report(tower: ConvTower, grid: int, images: Tensor, labels: Tensor, weights: Tensor) -> str:
    """What a tower gets right of scenes it was not trained on, in a line."""
    losses, shares = [], []
    for start in range(0, len(images), 64):
        part = to_unit_range(images[start : start + 64])
        loss, share = tower_loss(tower, grid, part, labels[start : start + 64].long(), weights)
        losses.append(loss)
        shares.append(share)
    named = zip(CLASSES, torch.stack(shares).nanmean(0).tolist(), strict=True)
    return f"held out {torch.stack(losses).mean():.4f}, right: " + ", ".join(f"{n} {s:.2f}" for n, s in named)


def _class_weights(labels: Tensor) -> Tensor:
    """Rare classes count more: the inverse root of how often a class is seen, 1 on average over places."""
    counts = torch.bincount(labels.flatten().long(), minlength=len(CLASSES)).float()
    weights = (counts + 1).rsqrt()
    return weights * counts.sum() / (weights * counts).sum()
