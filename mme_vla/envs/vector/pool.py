"""Many environments at once, each in its own process; a policy batches those that are ready.

    with make_vec_env("PickXtimes", episodes=range(50), workers=8) as envs:
        for worker in range(envs.workers):
            envs.start_next(worker)
        while envs.busy:
            for reply in envs.recv():
                ...  # reply.job, reply.observation, reply.info; then
                # or, when reply.done: envs.start_next(reply.worker)
                envs.send(reply.worker, action)

The process of each worker runs `serve`. It inherits nothing of the script that makes one
(`worker.py`), which therefore keeps its work under `if __name__ == "__main__":`.
"""

import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import wait
from typing import Any

from mme_vla.envs.base import environment, open_episode
from mme_vla.envs.episodes import choose_episodes
from mme_vla.envs.make import ACTION_SPACES, ROBOMME, make_env
from mme_vla.envs.observations import Include, RenderRequest
from mme_vla.envs.vector import worker as protocol
from mme_vla.envs.vector.worker import begin, settings, simulating_processes
from mme_vla.errors import SceneError, UserError, check_known, require, text_of
from mme_vla.registry import REWARDS
from mme_vla.utils.processes import check_main_guard, signals_deferred


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
    """The result of one worker: of a reset, which has no reward, or of a step."""

    worker: int
    job: Job
    observation: Any
    reward: Any
    terminated: bool
    truncated: bool
    info: Any
    """What the environment sends: a dictionary, or the `Report` of a rollout's environment. With an
    `error` it is a dictionary of it.
    """
    error: Exception | None = None
    """Why the command failed: what the environment raised, or a `WorkerCrash`."""

    @property
    def is_reset(self) -> bool:
        """Whether it is the result of a reset."""
        return self.reward is None

    @property
    def done(self) -> bool:
        """Whether the episode is over."""
        if self.terminated or self.truncated:
            return True
        if isinstance(self.info, dict):
            return self.info.get("status") == "error"
        return self.info.status == "error"

    @classmethod
    def of_outcome(cls, worker: int, job: Job, resetting: bool, outcome: tuple) -> "Reply":
        """From what `reset` or `step` returned."""
        if resetting:
            observation, info = outcome
            return cls(worker, job, observation, None, False, False, info)
        observation, reward, terminated, truncated, info = outcome
        return cls(worker, job, observation, reward, bool(terminated), bool(truncated), info)

    @classmethod
    def of_failure(cls, worker: int, job: Job, resetting: bool, error: Exception) -> "Reply":
        """Of a command that came to nothing; the message names the episode."""
        info = {
            "status": "error",
            "error_message": f"{job}: {text_of(error)}",
            "exception_type": type(error).__name__,
        }
        reward = None if resetting else 0.0
        return cls(worker, job, None, reward, True, False, info, error)


class WorkerCrash(RuntimeError):  # noqa: N818  (the name that records of crashes have)
    """A worker process died, or gave no result in time."""


_CLOSING_SECONDS = 5.0
_STARTING_SECONDS = 120.0


@dataclass
class _Worker:
    process: Any
    connection: Any
    job: Job | None = None
    running: bool = False
    """A command was given and its result is due."""
    resetting: bool = False
    deadline: float = math.inf

    @property
    def current_job(self) -> Job:
        assert self.job is not None
        return self.job


class VecEnv:
    """Worker processes that run episodes, each at its own pace.

    Args:
        jobs: the episodes, in the order `start_next` hands them out.
        workers: number of processes.
        factory: makes an environment from `task`, `split` and `episode`; importable by name, or a
            `partial` of such a function with its further arguments.
        timeout: seconds after which a command without result counts as hung, and its worker is
            replaced. The wait of `recv`, and the outcome `timeout` of an episode (its step limit),
            are other things.
    """

    def __init__(
        self,
        jobs: Iterable[Job],
        workers: int,
        factory: Callable[..., Any] = make_env,
        timeout: float = 600.0,
    ) -> None:
        require(
            type(workers) is int and workers >= 1,
            f"workers is {workers!r}; expected a positive integer.",
        )
        check_main_guard()
        require(timeout > 0, f"timeout is {timeout!r}; expected a positive number of seconds.")
        self.jobs = deque(jobs)
        """Episodes that no worker has begun yet."""
        self.timeout = timeout
        self._factory = factory
        self._context = simulating_processes()
        self._workers: list[_Worker] = []
        try:
            for _ in range(workers):
                self._workers.append(self._spawn())
        except BaseException:
            self.close()
            raise

    # Commands -------------------------------------------------------------------------------------

    @property
    def workers(self) -> int:
        """Number of worker processes."""
        return len(self._workers)

    @property
    def busy(self) -> bool:
        """Whether a reply is still to come."""
        return any(worker.running for worker in self._workers)

    def start_next(self, worker: int) -> Job | None:
        """Let a worker begin the next episode; None when there is none left."""
        self._idle(worker)
        if not self.jobs:
            return None
        job = self.jobs.popleft()
        self.start(worker, job)
        return job

    def start(self, worker: int, job: Job, images: RenderRequest | None = None) -> None:
        """Let a worker begin an episode; its reply carries the first observation.

        Args:
            images: those that are requested of the reset, where the environment takes chunks;
                by default all.
        """
        state = self._idle(worker)
        state.job = job
        state.resetting = True
        arguments = {"task": job.task, "split": job.split, "episode": job.episode}
        options = {} if images is None else {"images": images}
        self._command(state, protocol.RESET, arguments, options)

    def send(self, worker: int, action: Any) -> None:
        """Let a worker perform an action; returns at once."""
        state = self._idle(worker)
        require(
            state.job is not None,
            f"Worker {worker} runs no episode; call start() or start_next() first.",
        )
        state.resetting = False
        self._command(state, protocol.STEP, action)

    def recv(self, timeout: float | None = None) -> list[Reply]:
        """Wait until at least one worker is ready, and take the replies of all that are.

        A worker that died, hangs or raised anything but a `UserError` or `SceneError` is replaced.
        Its reply has the status `error` and, as `error`, a `WorkerCrash` or what was raised; the
        others continue.

        Args:
            timeout: seconds that this call waits at most, whatever hangs; None waits as long as
                commands may take.

        Returns:
            Replies in the order of the workers; empty when the time is up or nothing is under way.
        """
        self._require_open()
        until = math.inf
        if timeout is not None:
            until = time.monotonic() + timeout
        while True:
            replies = []
            for index, state in enumerate(self._workers):
                if state.running:
                    reply = self._poll(index, state)
                    if reply is not None:
                        replies.append(reply)
            if replies or not self.busy or time.monotonic() >= until:
                return replies
            running = [state for state in self._workers if state.running]
            seconds = min([until, *(state.deadline for state in running)]) - time.monotonic()
            wait([state.connection for state in running], timeout=max(0.0, min(seconds, 60.0)))

    def close(self) -> None:
        """Stop all workers; closing twice is harmless."""
        for state in self._workers:
            with suppress(OSError):  # it may be gone already
                protocol.send(state.connection, protocol.CLOSE)
                state.connection.close()  # ends the sending of a reply that was not taken
        until = time.monotonic() + _CLOSING_SECONDS
        for state in self._workers:
            state.process.join(max(0.0, until - time.monotonic()))
            protocol.end(state.process)
        self._workers = []

    def __enter__(self) -> "VecEnv":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # Workers --------------------------------------------------------------------------------------

    def _spawn(self) -> _Worker:
        connection, remote = self._context.Pipe()
        arguments = (settings(), remote, self._factory)
        process = self._context.Process(target=serve, args=arguments, daemon=True)
        with signals_deferred():
            process.start()
        remote.close()
        return _Worker(process, connection)

    def _idle(self, worker: int) -> _Worker:
        self._require_open()
        last = len(self._workers) - 1
        require(0 <= worker <= last, f"Unknown worker {worker}; expected 0 to {last}.")
        state = self._workers[worker]
        message = f"Worker {worker} is still at its last command; call recv() first."
        require(not state.running, message)
        return state

    def _command(self, state: _Worker, *message: Any) -> None:
        state.running = True
        state.deadline = time.monotonic() + self.timeout
        if state.resetting:
            state.deadline += _STARTING_SECONDS
        with suppress(OSError):  # of a process that ended, `recv` finds the connection closed
            protocol.send(state.connection, *message)

    def _poll(self, index: int, state: _Worker) -> Reply | None:
        """Take the reply of a worker, if it has sent one."""
        try:
            if state.connection.poll():
                kind, content = protocol.receive(state.connection)
                if kind == protocol.RESULT:
                    state.running = False
                    return Reply.of_outcome(index, state.current_job, state.resetting, content)
                if isinstance(content, UserError | SceneError):
                    state.running = False
                    return Reply.of_failure(index, state.current_job, state.resetting, content)
                # After any other error the process may be of no further use: a renderer that has
                # lost its device fails until its process ends.
                return self._replace(index, content)
        except (EOFError, OSError):
            return self._crashed(index, protocol.last_words(state.process))
        if time.monotonic() > state.deadline:
            return self._crashed(index, f"gave no result within {self.timeout:g} s")
        return None

    def _crashed(self, index: int, what: str) -> Reply:
        return self._replace(index, WorkerCrash(f"the worker process {what}"))

    def _replace(self, index: int, error: Exception) -> Reply:
        """Start a new process for a worker, and report the failure of its command."""
        old = self._workers[index]
        old.connection.close()
        old.process.join(1.0)  # unless it hangs, it closes its environment and ends by itself
        protocol.end(old.process)
        self._workers[index] = self._spawn()
        return Reply.of_failure(index, old.current_job, old.resetting, error)

    def _require_open(self) -> None:
        require(self._workers, "The environments are closed; make new ones.")


def serve(inherited: Any, connection: Any, factory: Callable[..., Any]) -> None:
    """The work of a worker process: run commands until `CLOSE` or the end of the connection."""
    begin(*inherited)  # `settings` of the process that started it
    os.environ["OMP_NUM_THREADS"] = "1"  # the workers themselves are the parallelism
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)
    env: Any = None
    try:
        while True:
            command, *arguments = protocol.receive(connection)
            if command == protocol.CLOSE:
                return
            try:
                if command == protocol.RESET:
                    if env is not None:
                        env.close()
                        env = None
                    env = factory(**arguments[0])
                    outcome: Any = env.reset(**arguments[1])
                else:
                    outcome = env.step(arguments[0])
            except Exception as error:
                protocol.send(connection, protocol.FAILURE, protocol.portable(error))
            else:
                protocol.send(connection, protocol.RESULT, outcome)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    finally:
        if env is not None:
            env.close()


def make_vec_env(
    tasks: str | Sequence[str],
    episodes: Any = None,
    workers: int = 2,
    split: str = "test",
    action_space: str = "joint_angle",
    *,
    max_steps: int | None = None,
    render: bool = True,
    reward: str = "none",
    include: Include | None = None,
    timeout: float = 600.0,
    env: str = ROBOMME,
) -> VecEnv:
    """Environments for all given episodes of all given tasks.

    Args:
        tasks, episodes: as in `choose_episodes`; by default all of the split.
        workers: number of processes; more than the machine has cores is of no use.
        split: as for `make_env`.
        action_space, max_steps, render, reward, include: as for `make_env`; the last two are for
            RoboMME alone.
        timeout: seconds after which a command without result counts as hung.
        env: the environment whose tasks these are.
    """
    environment(env).check_installed()
    # A process would end with a traceback.
    require(
        env == ROBOMME or (reward == "none" and include is None),
        f"env={env} takes no reward and no include: they are for env={ROBOMME}.",
    )
    shared: dict[str, Any] = {
        "action_space": action_space,
        "max_steps": max_steps,
        "render": render,
    }
    make = partial(open_episode, env, **shared)
    if env == ROBOMME:
        check_known("action space", action_space, ACTION_SPACES)
        check_known("reward", reward, REWARDS)
        make = partial(make_env, **shared, reward=reward, include=include)
    specs = choose_episodes(tasks, episodes, split, env)
    jobs = [Job(spec.task, spec.split, spec.episode) for spec in specs]
    return VecEnv(jobs, workers, make, timeout)
