"""Parameters and memory of every model at full size, counted on the meta device.

    python benchmarks/sizes.py [--backbone pi05]

Training memory is weights, gradients, AdamW's two moments and the EMA in float32 for what is trained, plus the frozen
tower; activations come on top.
"""

import argparse

from mme_vla import build_policy
from mme_vla.testing.small import MODELS

GIB = 2**30


def row(name: str, backbone: str = "pi05") -> str:
    """A model's line of the table."""
    policy = build_policy(name, backbone=backbone, device="meta")
    total = sum(p.numel() for p in policy.parameters())
    frozen = sum(p.numel() for p in policy.backbone.vision.parameters())
    training = (total - frozen) * 5 * 4 + frozen * 4
    sizes = [f"{size / GIB:.1f} GiB" for size in (2 * total, 4 * total, training)]
    return f"| `{name}` | {total / 1e6:,.1f} M | {frozen / 1e6:,.1f} M | {' | '.join(sizes)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backbone", default="pi05")
    args = parser.parse_args()
    print("| model | parameters | of these frozen | weights bf16 | weights float32 | training |")
    print("|---|---:|---:|---:|---:|---:|")
    for name in MODELS:
        print(row(name, args.backbone))


if __name__ == "__main__":
    main()
