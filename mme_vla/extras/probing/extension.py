"""What probes and analyses add: names alone."""

from pathlib import Path

from mme_vla.registry import Command, Extension

MEMORY = (
    "shuffle",
    "drop",
    "swap",
    "delay",
    "recent",
    "oracle",
    "distract",
    "nodemo",
    "subgoal_swap",
    "subgoal_delay",
    "subgoal_count",
)
"""Interventions on what is remembered and said, and on which episodes and videos are shown."""
STREAM = (
    "forget",
    "replay",
    "shuffle_frames",
    "swap_frames",
    "linger",
    "late",
    "freeze_state",
    "goal_swap",
)
"""Interventions on what a policy is sent."""

EXTENSION = Extension(
    parts={
        "perturbation": {
            **dict.fromkeys(STREAM, "mme_vla.extras.probing.streams"),
            **dict.fromkeys(MEMORY, "mme_vla.extras.probing.interventions"),
        },
    },
    commands={
        "analyse": Command(
            "mme_vla.extras.probing.cli.analyse",
            "what a memory attends to, selects, modulates and costs",
            processes="any",
        ),
        "probe": Command(
            "mme_vla.extras.probing.cli.probe",
            "what a policy takes from its memory, on recorded episodes and in closed loop",
            config="probe",
            processes="shared",
            reads_words=True,
        ),
    },
    configs=Path(__file__).parent / "configs",
)
