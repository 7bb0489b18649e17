"""Parameters and memory of every model at full size, counted on the meta device.

    python benchmarks/sizes.py [--backbone pi05 | --prior]

Training memory is weights, gradients, AdamW's two moments and the EMA in float32 for what is
trained, plus the frozen tower; activations come on top. `--prior` counts the prior methods as their
recipes (`configs/experiment`) train them: without an EMA where they have none, and frozen weights
in the dtype that they are held in.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import torch
from omegaconf import OmegaConf

from mme_vla import build_policy
from mme_vla.config.composition import compose
from mme_vla.policy.build import build_from_config
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.testing.small import NEURAL

GIB = 2**30
FULL_PRECISION = 4  # bytes
RECIPES = (
    ("experiment=diffusion_policy",),
    ("experiment=sam2act_first",),
    ("experiment=sam2act_memory",),
    ("experiment=openvla_oft",),
    ("experiment=openvla_oft", "model=openvla_oft_tokendrop_context", "finetune=oft_memory"),
    ("experiment=openvla_oft", "model=openvla_oft_framesamp_context", "finetune=oft_memory"),
    ("experiment=memoryvla",),
    ("experiment=memoryvla", "memory=framesamp", "finetune.freeze_vision=true"),
    ("experiment=simplememvla",),
)


def of_model(name: str, backbone: str = "pi05") -> str:
    """The line of a model trained whole, but for its vision tower."""
    policy = build_policy(name, backbone=backbone, device="meta")
    total = sum(p.numel() for p in policy.parameters())
    frozen = sum(p.numel() for p in policy.backbone.vision.parameters())
    return line(
        f"`{name}`", total, frozen, (total - frozen) * 5 * FULL_PRECISION + frozen * FULL_PRECISION
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--backbone", default="pi05")
    parser.add_argument("--prior", action="store_true", help="the prior methods, by their recipes")
    args = parser.parse_args()
    print("| model | parameters | of these frozen | weights bf16 | weights float32 | training |")
    print("|---|---:|---:|---:|---:|---:|")
    if args.prior:
        for words in RECIPES:
            print(of_recipe(words), flush=True)
        return
    for name in ("pi05", *NEURAL):
        print(of_model(name, args.backbone))


def of_recipe(words: Sequence[str]) -> str:
    """The line of a recipe: parameters without its adapters, and what its own fine-tuning keeps
    while training.
    """
    cfg = compose("train", list(words))
    options: Any = OmegaConf.to_container(cfg.finetune, resolve=True)
    policy = build_from_config(cfg, device="meta")
    total = sum(p.numel() for p in policy.parameters())
    with torch.device("meta"):
        apply_finetuning(policy, options.pop("mode"), **options)
    copies = 4 + (cfg.train.ema > 0)
    learning = [p.numel() for p in policy.parameters() if p.requires_grad]
    still = [p for p in policy.parameters() if not p.requires_grad]
    training = sum(learning) * copies * FULL_PRECISION + sum(
        p.numel() * p.element_size() for p in still
    )
    name = f"`{cfg.name}`" + (f", stage `{cfg.policy.stage}`" if "stage" in cfg.policy else "")
    return line(name, total, sum(p.numel() for p in still), training)


def line(name: str, total: int, frozen: int, training: int) -> str:
    """A line of the table: parameters, and bytes while training."""
    sizes = [f"{size / GIB:.1f} GiB" for size in (2 * total, FULL_PRECISION * total, training)]
    return f"| {name} | {total / 1e6:,.1f} M | {frozen / 1e6:,.1f} M | {' | '.join(sizes)} |"


if __name__ == "__main__":
    main()
