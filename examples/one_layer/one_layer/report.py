"""The command `mme-vla one-layer CHECKPOINT`."""

import argparse

from mme_vla import Policy


def main():
    parser = argparse.ArgumentParser(description="Count the weights of a checkpoint's layer.")
    parser.add_argument("checkpoint")
    # A command without YAML declares this flag itself.
    parser.add_argument("--trust-plugins", action="store_true")
    args = parser.parse_args()
    layer = Policy.from_pretrained(args.checkpoint, trust_plugins=args.trust_plugins).layer
    print(f"{layer.weight.numel():,} weights")
