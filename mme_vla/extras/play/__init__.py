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
    name: f"mme_vla.{module}"
    for module, names in {
        "embodiment.action_space": ["Option"],
        "extras.play.game": ["ChoiceSession", "Decision", "Reveal"],
        "extras.play.players": [
            "PLAYERS",
            "NoChoiceError",
            "OraclePlayer",
            "Player",
            "RandomPlayer",
            "build_player",
        ],
        "extras.play.vlm_players": ["GeminiPlayer", "OpenAIPlayer", "QwenPlayer"],
    }.items()
    for name in names
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
