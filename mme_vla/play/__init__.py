"""The tasks as questions with a few answers: clips are shown, the next action is chosen, an oracle planner does it."""

from mme_vla.embodiment.options import Option
from mme_vla.play.game import ChoiceSession, Decision, EpisodeId, Reveal
from mme_vla.play.players import PLAYERS, NoChoiceError, OraclePlayer, Player, RandomPlayer, build_player
from mme_vla.play.vlm_players import GeminiPlayer, OpenAIPlayer, QwenPlayer

__all__ = [
    "PLAYERS", "ChoiceSession", "Decision", "EpisodeId", "GeminiPlayer", "NoChoiceError", "OpenAIPlayer", "Option",
    "OraclePlayer", "Player", "QwenPlayer", "RandomPlayer", "Reveal", "build_player",
]  # fmt: skip
