"""Failures that repeat themselves, which end a rollout: the next episodes would fail as well."""

from mme_vla.envs.vector.pool import Reply
from mme_vla.errors import SceneError, UserError, place_of, text_of

GIVE_UP_AFTER = 8  # episodes in a row that could not be started, or without a chunk
SAME_ERRORS = 2  # equal errors that an environment's code raised, in a row


class FailureStreaks:
    """Counts the failures of a rollout's episodes in a row, by kind."""

    def __init__(self) -> None:
        self._not_started = 0  # episodes whose environments failed before the first frame
        self._without_chunk = 0  # episodes in which the policy chose no chunk
        self._same_errors = 0  # episodes that the same error of an environment's code ended
        self._error = ""  # the last one

    def note_start(self) -> None:
        """An environment delivered its first frames."""
        self._not_started = 0

    def note_chunk(self) -> None:
        """The policy chose a chunk."""
        self._without_chunk = 0

    def note_end(self, reply: Reply, message: str | None, is_repeated: bool) -> None:
        """An episode ended with this reply of its environment.

        message: of the error; None without one.
        is_repeated: whether the episode had been tried before. Such are not counted: they are the
            ones that failed, so failures follow each other among them.

        Raises:
            UserError: the environment's own code failed in the same way again, or
                `GIVE_UP_AFTER` environments in a row could not be started.
        """
        # A scene in which an object finds no place finds none again, and says nothing of the
        # simulator.
        is_unbuildable = isinstance(reply.error, SceneError)
        if reply.is_reset and not is_unbuildable:
            self._not_started += 1
        if reply.error is None:
            self._same_errors = 0
        elif place_of(reply.error) is not None and not is_repeated:
            text = text_of(reply.error)
            if text != self._error:
                self._error = text
                self._same_errors = 0
            self._same_errors += 1
            if self._same_errors >= SAME_ERRORS:
                raise UserError(
                    f"{self._same_errors} episodes in a row ended in the same error of the"
                    f" environment's code, so the run stops: {text} Mend it, and repeat the"
                    " command: finished episodes are kept."
                )
        if self._not_started >= GIVE_UP_AFTER:
            raise UserError(
                f"{self._not_started} environments in a row could not be started, so the run"
                f" stops; the last one: {message}"
            )

    def note_no_chunk(self, reason: str) -> None:
        """The policy failed at an episode's first chunk.

        Raises:
            UserError: it did so in `GIVE_UP_AFTER` episodes in a row.
        """
        self._without_chunk += 1
        if self._without_chunk >= GIVE_UP_AFTER:
            raise UserError(
                f"The policy chose no chunk in {self._without_chunk} episodes in a row, so the run"
                f" stops; the last one: {reason}"
            )
