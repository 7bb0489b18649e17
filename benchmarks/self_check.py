"""How far the chunk of a self-check moves on another machine, and how far with wrong weights.

    python benchmarks/self_check.py [CHECKPOINT…] [--models pi05 framesamp_modul …]

Without arguments: the two shipped policies and small untrained ones of several kinds. A checkpoint
is a folder, a model one of the names of `model=`, at tiny size. Each policy records its self-check
in float32 with one thread. A row is one change: threads, order of sums, kernels without vector
instructions, bfloat16, and what must fail. `chunk` is the mean difference as a share of the chunk's
mean size, `actions` that of the robot's actions which the stored chunk becomes.
"""

import argparse
import copy
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from mme_vla import MMEPolicy, Policy, build_policy
from mme_vla.policy.run_folders import locate_checkpoint
from mme_vla.policy.saving import save_policy
from mme_vla.policy.self_check import (
    Comparison,
    compare,
    predict_chunk,
    record_self_check,
    relative_difference,
)
from mme_vla.processing.normalise import QuantileStats
from mme_vla.testing.small import open_gates, unit_stats

SHIPPED = ("nano", "nano16")
MODELS = ("pi05", "diffusion_policy")
SHIFT = 0.1
"""Of the range of wrong statistics."""


def untrained(model: str, seed: int = 0) -> Policy:
    """A small policy of a model, with unit statistics."""
    policy = build_policy(model, seed=seed)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    if isinstance(policy, MMEPolicy):
        open_gates(policy)
    else:
        fill_zeros(policy)
    return policy.eval()


def fill_zeros(policy: Policy) -> None:
    """Draw the matrices at random that training begins with at zero: a chunk that is zero, whatever
    the other weights, would tell nothing.
    """
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for _, parameter in sorted(policy.named_parameters()):
            if parameter.ndim > 1 and not parameter.any():
                std = parameter.shape[-1] ** -0.5
                parameter.copy_(std * torch.randn(parameter.shape, generator=generator))


def perturbed(policy: Policy, share: float) -> Policy:
    """A copy whose weights are each multiplied by 1 ± about `share`."""
    changed = copy.deepcopy(policy)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in changed.parameters():
            factors = 1 + share * torch.randn(parameter.shape, generator=generator)
            parameter.mul_(factors)
    return changed


def other_seed(policy: Policy) -> Policy:
    """A policy of the same configuration with fresh weights."""
    torch.manual_seed(1)
    config = copy.deepcopy(policy.config)
    vision = config["backbone"].get("vision") or {}
    if "pretrained" in vision:
        vision["pretrained"] = False
    fresh = type(policy).from_config(config, policy.processor)
    if not isinstance(fresh, MMEPolicy):
        fill_zeros(fresh)
    return fresh.eval()


def swapped(policy: Policy) -> Iterator[tuple[str, Policy]]:
    """For each stack of equal layers a copy in which the first two have changed places."""
    for name, module in policy.named_modules():
        if not isinstance(module, nn.ModuleList) or len(module) < 2:
            continue
        first, second = module[0].state_dict(), module[1].state_dict()
        if not first or [t.shape for t in first.values()] != [t.shape for t in second.values()]:
            continue
        changed = copy.deepcopy(policy)
        layers = changed.get_submodule(name)
        assert isinstance(layers, nn.ModuleList)
        layers[0], layers[1] = layers[1], layers[0]
        yield name, changed


def shifted(stats: QuantileStats) -> QuantileStats:
    """Statistics moved by `SHIFT` of their range."""
    change = SHIFT * (stats.q99 - stats.q01)
    values_by_name: dict[str, np.ndarray] = {}
    for name in ("mean", "q01", "q99", "min", "max"):
        values = getattr(stats, name)
        if values is not None:
            values_by_name[name] = values + change
    return replace(stats, **values_by_name)


def other_statistics(policy: Policy, name: str) -> Policy:
    """A copy whose `state` or `actions` have other statistics."""
    changed = copy.deepcopy(policy)
    stats = changed.require_processor().require_stats()
    parts = {"state": stats.state, "actions": stats.actions}
    parts[name] = shifted(parts[name])
    changed.require_processor().stats = type(stats)(**parts)
    return changed


class Measurement:
    """The rows of one policy."""

    def __init__(self, title: str, policy: Policy) -> None:
        self.title = title
        self.policy = policy
        torch.set_num_threads(1)
        self.check = record_self_check(policy)

    def print_row(self, change: str, chunk: float, actions: float) -> None:
        print(f"| {self.title} | {change} | {chunk:.1e} | {actions:.1e} |", flush=True)

    def policy_row(self, change: str, policy: Policy) -> None:
        """Print the differences of a policy from the self-check."""
        chunk, actions = predict_chunk(policy, self.check, stored=True)
        stored = self.check
        self.print_row(
            change,
            relative_difference(chunk, stored.chunk),
            relative_difference(actions, stored.actions),
        )

    def machines(self) -> None:
        """What another machine changes."""
        torch.set_num_threads(2)
        self.policy_row("two threads", self.policy)
        torch.set_num_threads(1)
        torch.use_deterministic_algorithms(True, warn_only=True)
        self.policy_row("deterministic algorithms", self.policy)
        torch.use_deterministic_algorithms(False)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            save_policy(self.policy, folder, self_check=self.check)
            kernels = {"ATEN_CPU_CAPABILITY": "default", "ONEDNN_MAX_CPU_ISA": "SSE41"}
            self.process_row("float32, other kernels", folder, "float32", kernels)
            self.process_row("bfloat16", folder, "bfloat16", {})
            self.process_row("bfloat16, other kernels", folder, "bfloat16", kernels)

    def process_row(self, change: str, folder: Path, dtype: str, kernels: dict[str, str]) -> None:
        """Predict in a process of its own, whose kernels are selected when it starts."""
        command = [sys.executable, __file__, "--predict", str(folder), "--dtype", dtype]
        reply = subprocess.run(
            command, env={**os.environ, **kernels}, check=False, capture_output=True, text=True
        )
        if reply.returncode:
            reason = reply.stderr.strip().splitlines()[-1]
            print(f"| {self.title} | {change} | cannot run: {reason} | |", flush=True)
            return
        self.print_row(change, *json.loads(reply.stdout.splitlines()[-1]))

    def faults(self) -> None:
        """What must fail."""
        for share in (0.001, 0.01, 0.1):
            self.policy_row(f"weights ± {share:.1%}", perturbed(self.policy, share))
        self.policy_row("another seed's weights", other_seed(self.policy))
        for name, policy in swapped(self.policy):
            self.policy_row(f"layers 0 and 1 of {name} swapped", policy)
        for name in ("state", "actions"):
            self.policy_row(f"statistics of {name}", other_statistics(self.policy, name))


def predict(folder: Path, dtype: str) -> None:
    """Print the differences from the self-check of a checkpoint."""
    torch.set_num_threads(1)
    result: Comparison | None = compare(Policy.from_pretrained(folder, dtype=dtype), folder)
    assert result is not None
    print(json.dumps([result.chunk, result.actions]))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoints", nargs="*")
    parser.add_argument("--models", nargs="*")
    parser.add_argument("--predict", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--dtype", default="float32", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.predict is not None:
        predict(arguments.predict, arguments.dtype)
        return
    checkpoints, models = arguments.checkpoints, arguments.models
    if not checkpoints and models is None:
        checkpoints, models = SHIPPED, MODELS
    policies: list[tuple[str, Callable[[], Policy]]] = []
    for name in checkpoints:
        policies.append((name, lambda name=name: Policy.from_pretrained(locate_checkpoint(name))))
    for name in models or ():
        policies.append((f"{name}, untrained", lambda name=name: untrained(name)))
    print("| policy | change | chunk | actions |\n|---|---|---:|---:|")
    for title, load in policies:
        measurement = Measurement(title, load())
        measurement.machines()
        measurement.faults()


if __name__ == "__main__":
    main()
