"""What this package adds: names alone."""

from pathlib import Path

from mme_vla.registry import Command, Extension

EXTENSION = Extension(
    parts={"policy": {"one_layer": "one_layer.policy"}},
    commands={"one-layer": Command("one_layer.report", "the weights of a checkpoint's layer")},
    configs=Path(__file__).parent / "configs",
)
