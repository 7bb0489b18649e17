"""Who plays when no person does: the interface of players, and the two that need no model."""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError
from mme_vla.extras.play.game import MAX_CHOICES, ChoiceSession
from mme_vla.registry import PLAYERS


class NoChoiceError(Exception):
    """A player does not continue. outcome: what the episode counts as; the message says why."""

    def __init__(self, outcome: str, reason: str) -> None:
        super().__init__(reason)
        self.outcome = outcome


class Player:
    """The interface of every player. A subclass implements `choose`, and overrides the rest where
    it needs to.

    Attributes:
        model: what its records are filed under.
        needs_images: whether it reads images; for one that does not, nothing is rendered, which is
            much faster.
        max_choices: choices after which an episode has timed out where none are set; None: any
            number.
    """

    model = "player"
    needs_images = True
    max_choices: int | None = MAX_CHOICES

    def start(self, session: ChoiceSession) -> None:
        """Take note of a new episode, which has been started."""

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        """The next action {"choice", "point"} and a note to keep with it.

        Raises:
            NoChoiceError: the player does not continue.
        """
        raise NotImplementedError

    def notes(self) -> dict[str, Any]:
        """What to keep with the record of the episode that has ended."""
        return {}

    def close(self) -> None:
        """Give back what the player holds."""


def play(session: ChoiceSession, player: Player) -> ChoiceSession:
    """Play a whole episode."""
    session.start()
    player.start(session)
    while not session.over:
        try:
            action, note = player.choose(session)
        except NoChoiceError as error:
            session.give_up(error.outcome, str(error))
        else:
            session.choose(action, note)
    return session


@PLAYERS.register("random")
class RandomPlayer(Player):
    """Any option, any pixel: the floor. seed: with the episode, decides what is chosen."""

    model = "random"
    needs_images = False

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        self._draws = np.random.default_rng(seed)

    def start(self, session: ChoiceSession) -> None:
        """Draw anew for each episode, whichever were played before."""
        which = session.episode
        self._draws = np.random.default_rng(
            [self.seed, zlib.crc32(which.task.encode()), which.seed]
        )

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        option = session.options[self._draws.integers(len(session.options))]
        point = self._draws.integers(SIDE, size=2).tolist() if option.needs_point else None
        return {"choice": option.label, "point": point}, {}


@PLAYERS.register("oracle")
class OraclePlayer(Player):
    """Knows the task's own script: the option that carries out the current sub-task, on the object
    it is about. For another environment it calls `oracle()`.

    The upper bound of the protocol: what it fails at, planning or the rules of multi-choice failed
    at.
    """

    model = "oracle"
    needs_images = False

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        from mme_vla.envs.oracle import OracleStuckError, oracle_choice

        task = getattr(session.env, "task", None)
        if task is None:
            choice = session.env.oracle()
            if choice is None:
                raise UserError(
                    "player=oracle: this environment has no oracle. Give it a method oracle(),"
                    ' which returns {"choice": letter}, or use env=mme_vla.'
                )
            return dict(choice), {}
        try:
            action, text = oracle_choice(task)
        except OracleStuckError as error:
            raise NoChoiceError("error", str(error)) from None
        return action, {"subtask": text}


def build_player(config: Mapping[str, Any]) -> Player:
    """Build from the section `player` of a configuration."""
    player: Player = PLAYERS.build(config)
    return player
