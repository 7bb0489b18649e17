"""What nanoMME adds: names alone."""

from pathlib import Path

from mme_vla.registry import Command, Extension

_ASSETS = Path(__file__).parents[2] / "assets"

EXTENSION = Extension(
    parts={"backbone": {"nano": "mme_vla.extras.nano.backbone"}},
    commands={
        "nano": Command(
            "mme_vla.extras.nano.cli.nano",
            "small policies from nothing to results on two cores; `nano board` ranks them",
            config="nano",
            reads_words=True,
        ),
        "vision-pretrain": Command(
            "mme_vla.extras.nano.cli.vision_pretrain",
            "the vision tower of the nano backbone, from renders of the tasks",
            "vision_pretrain",
        ),
    },
    configs=Path(__file__).parent / "configs",
    checkpoints={"nano": _ASSETS / "nano", "nano16": _ASSETS / "nano16"},
)
