"""What audits add: names alone."""

from pathlib import Path

from mme_vla.registry import Command, Extension

EXTENSION = Extension(
    commands={
        "audit": Command(
            "mme_vla.extras.audit.cli",
            "what a policy, loaded or served, takes from its history",
            "audit",
        ),
    },
    configs=Path(__file__).parent / "configs",
)
