"""The command `mme-vla one-layer CHECKPOINT`."""

import sys

from mme_vla import Policy


def main():
    layer = Policy.from_pretrained(sys.argv[1], trust_plugins=True).layer
    print(f"{layer.weight.numel():,} weights")
