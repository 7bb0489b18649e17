"""Environments of a rollout without worker processes."""

from collections.abc import Mapping
from typing import Any

from mme_vla.envs.vector.pool import Job, Reply
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout.environment import ChunkEnv, make_rollout_env


class LocalEnvs:
    """One environment in this process, in place of a `VecEnv`."""

    workers = 1

    def __init__(self, options: Mapping[str, Any]) -> None:
        self._options, self._job = dict(options), Job("", "", 0)
        self._env: ChunkEnv | None = None
        self._replies: list[Reply] = []

    @property
    def busy(self) -> bool:
        """Whether a reply is waiting."""
        return bool(self._replies)

    def start(self, worker: int, job: Job, **how: Any) -> None:
        """Begin an episode."""
        self._close()
        self._job = job
        try:
            self._env = make_rollout_env(job.task, job.split, job.episode, **self._options)
            self._add(Reply.of_outcome(worker, job, True, self._env.reset(**how)))
        except UserError:
            raise
        except Exception as error:  # a scene that cannot be built ends its episode, not the others
            self._add(Reply.of_failure(worker, job, True, type(error).__name__, str(error)))

    def send(self, worker: int, action: Any) -> None:
        """Execute a chunk."""
        assert self._env is not None
        self._add(Reply.of_outcome(worker, self._job, False, self._env.step(action)))

    def recv(self, timeout: float | None = None) -> list[Reply]:
        """The reply that is waiting."""
        replies, self._replies = self._replies, []
        return replies

    def __enter__(self) -> "LocalEnvs":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _add(self, reply: Reply) -> None:
        if reply.done:
            self._close()
        self._replies.append(reply)

    def _close(self) -> None:
        if self._env is not None:
            self._env.close()
        self._env = None
