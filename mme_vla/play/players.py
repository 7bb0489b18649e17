"""Who plays when no person does: the interface of players, and the two that need no model."""

import zlib
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError
from mme_vla.play.game import ChoiceSession
from mme_vla.registry import PLAYERS


class NoChoiceError(Exception):
    """A player does not continue. outcome: what the episode counts as; the message says why."""

    def __init__(self, outcome: str, reason: str) -> None:
        super().__init__(reason)
        self.outcome = outcome


class Player:
    """The interface of every player. A subclass implements `choose`, and overrides the rest where it needs to.

    Attributes:
        model: what its records are filed under.
        needs_images: whether it reads images; for one that does not, nothing is rendered, which is much faster.
    """

    model = "player"
    needs_images = True

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
        self._draws = np.random.default_rng([self.seed, zlib.crc32(which.task.encode()), which.seed])

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        """See `Player`."""
        option = session.options[self._draws.integers(len(session.options))]
        point = self._draws.integers(SIDE, size=2).tolist() if option.needs_point else None
        return {"choice": option.label, "point": point}, {}


@PLAYERS.register("oracle")
class OraclePlayer(Player):
    """Knows the task's own script: the option that carries out the current sub-task, on the object it is about.

    The upper bound of the protocol: what it fails at, planning or the rules of multi-choice failed at.
    """

    model = "oracle"
    needs_images = False

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        """See `Player`."""
        from mme_vla.envs.grounding import project

        task = getattr(session.env, "task", None)
        if task is None:
            raise UserError("player=oracle reads the script of this library's tasks: use it with env=mme_vla.")
        subtask = task.progress.current
        if subtask is None:
            _stuck("every sub-task is done, but the episode has not ended")
        if subtask.video:
            _stuck(f"the conditioning video did not succeed ({subtask.text!r}), so the task cannot be done")
        choices = {choice.label: choice for choice in task.choices()}
        choice = choices.get(subtask.choice)
        if choice is None:
            _stuck(f"the sub-task {subtask.text!r} has no option")
        note = {"subtask": subtask.text}
        if choice.candidates is None:
            return {"choice": choice.label, "point": None}, note
        candidates = list(choice.candidates())
        # A sub-task may name the button it ends at as well: the point is of what the option chooses among.
        meant = [thing for thing in subtask.targets if any(thing is candidate for candidate in candidates)]
        if not meant:
            _stuck(f"the sub-task {subtask.text!r} is about nothing that its option can choose")
        pixel = np.clip(np.rint(project(meant[0].position)), 0, SIDE - 1)
        return {"choice": choice.label, "point": pixel.tolist()}, note


def _stuck(reason: str) -> NoReturn:
    raise NoChoiceError("error", f"the oracle is stuck: {reason}")


def build_player(config: Mapping[str, Any]) -> Player:
    """Build from the section `player` of a configuration."""
    player: Player = PLAYERS.build(config)
    return player
