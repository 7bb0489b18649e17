"""The tasks as multiple choice: clips are shown, the next action is chosen, an oracle planner
carries it out.

Names are imported when they are used, so that `python -m mme_vla.play` can be interrupted at once.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.embodiment.action_space import Option
    from mme_vla.extras.play.game import ChoiceSession, Decision, Reveal
    from mme_vla.extras.play.players import (
        PLAYERS,
        NoChoiceError,
        OraclePlayer,
        Player,
        RandomPlayer,
        build_player,
    )
    from mme_vla.extras.play.vlm_players import GeminiPlayer, OpenAIPlayer, QwenPlayer

__all__ = [
    "PLAYERS",
    "ChoiceSession",
    "Decision",
    "GeminiPlayer",
    "NoChoiceError",
    "OpenAIPlayer",
    "Option",
    "OraclePlayer",
    "Player",
    "QwenPlayer",
    "RandomPlayer",
    "Reveal",
    "build_player",
]

_HOMES = {
    "Option": "mme_vla.embodiment.action_space",
    **dict.fromkeys(("ChoiceSession", "Decision", "Reveal"), "mme_vla.extras.play.game"),
    **dict.fromkeys(
        ("PLAYERS", "NoChoiceError", "OraclePlayer", "Player", "RandomPlayer", "build_player"),
        "mme_vla.extras.play.players",
    ),
    **dict.fromkeys(
        ("GeminiPlayer", "OpenAIPlayer", "QwenPlayer"), "mme_vla.extras.play.vlm_players"
    ),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
