"""What the game of multiple choice adds: names alone."""

from pathlib import Path

from mme_vla.registry import Command, Extension

EXTENSION = Extension(
    parts={
        "player": {
            **dict.fromkeys(("random", "oracle"), "mme_vla.extras.play.players"),
            **dict.fromkeys(("qwenvl", "gemini", "openai"), "mme_vla.extras.play.vlm_players"),
        }
    },
    commands={
        "play": Command(
            "mme_vla.extras.play.cli",
            "play the tasks yourself, or let a model play",
            config="play",
        )
    },
    configs=Path(__file__).parent / "configs",
)
