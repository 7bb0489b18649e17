"""What a `VecEnv` is given and gives back: episodes, and what came of each command."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Job:
    """One episode to run."""

    task: str
    split: str
    episode: int

    def __str__(self) -> str:
        return f"{self.task} {self.split} episode {self.episode}"


@dataclass
class Reply:
    """What came back from one worker: of a reset (`reward` is None) or of a step."""

    worker: int
    job: Job
    observation: Any
    reward: Any
    terminated: bool
    truncated: bool
    info: dict[str, Any]
    crashed: bool = False
    """The worker died or hung and was replaced, or the environment raised: this says nothing about the policy."""

    @property
    def done(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated or self.info.get("status") == "error"

    @classmethod
    def of_outcome(cls, worker: int, job: Job, resetting: bool, outcome: tuple) -> "Reply":
        """From what `reset` or `step` returned."""
        if resetting:
            observation, info = outcome
            return cls(worker, job, observation, None, False, False, info)
        observation, reward, terminated, truncated, info = outcome
        return cls(worker, job, observation, reward, bool(terminated), bool(truncated), info)

    @classmethod
    def of_failure(cls, worker: int, job: Job, resetting: bool, kind: str, message: str) -> "Reply":
        """Of a command that came to nothing; the message names the episode."""
        info = {"status": "error", "error_message": f"{job}: {message}", "exception_type": kind}
        return cls(worker, job, None, None if resetting else 0.0, True, False, info, crashed=True)
