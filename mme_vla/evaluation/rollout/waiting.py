"""The episodes that wait to be run: this process's own, or those it shares with others."""

from collections.abc import Iterable

from mme_vla.envs.vector.jobs import Job
from mme_vla.evaluation.claims import Claims


class Waiting:
    """Episodes in the order they begin.

    Args:
        jobs: all that are left. claims: where other processes run the same ones; each then begins what it could claim.
    """

    def __init__(self, jobs: Iterable[Job] = (), claims: Claims | None = None) -> None:
        self._jobs, self._claims = list(jobs), claims
        self._again: list[Job] = []

    def take(self) -> Job | None:
        """The next episode to begin, if there is one; those tried again come last."""
        if self._claims is None:
            job = self._jobs.pop(0) if self._jobs else None
        else:
            job = self._claims.take(self._jobs)
            if job is not None:
                self._jobs.remove(job)
        return self._again.pop(0) if job is None and self._again else job

    def put_back(self, job: Job) -> None:
        """Have an episode run once more, by this process."""
        self._again.append(job)
