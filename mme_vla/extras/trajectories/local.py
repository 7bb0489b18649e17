"""Environments of a rollout without worker processes."""

from collections.abc import Callable
from typing import Any

from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.vector.pool import Job, Reply
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout.environment import ChunkEnv


class LocalEnvs:
    """One environment in this process, in place of a `VecEnv`.

    make: makes it from `task`, `split` and `episode` (an `EpisodeFactory`).
    """

    workers = 1

    def __init__(self, make: Callable[..., ChunkEnv]) -> None:
        self._make = make
        self._job = Job("", "", 0)
        self._env: ChunkEnv | None = None
        self._replies: list[Reply] = []

    @property
    def busy(self) -> bool:
        """Whether a reply is waiting."""
        return bool(self._replies)

    def start(self, worker: int, job: Job, images: RenderRequest | None = None) -> None:
        """Begin an episode."""
        self._close()
        self._job = job

        def begin() -> Any:
            self._env = self._make(task=job.task, split=job.split, episode=job.episode)
            return self._env.reset(images)

        self._run(worker, True, begin)

    def send(self, worker: int, action: Any) -> None:
        """Execute a chunk."""
        env = self._env
        assert env is not None
        self._run(worker, False, lambda: env.step(action))

    def recv(self, timeout: float | None = None) -> list[Reply]:
        """The reply that is waiting."""
        replies, self._replies = self._replies, []
        return replies

    def __enter__(self) -> "LocalEnvs":
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def _run(self, worker: int, first: bool, act: Callable[[], Any]) -> None:
        """Add the reply of a reset or a step; an error ends its episode, not the others."""
        try:
            reply = Reply.of_outcome(worker, self._job, first, act())
        except UserError:
            raise
        except Exception as error:
            reply = Reply.of_failure(worker, self._job, first, error)
        if reply.done:
            self._close()
        self._replies.append(reply)

    def _close(self) -> None:
        if self._env is not None:
            self._env.close()
        self._env = None
