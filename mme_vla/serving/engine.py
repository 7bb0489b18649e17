"""The one thread that runs the policy: waiting requests travel in one batch, long videos in pieces
between batches.
"""

import asyncio
import logging
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mme_vla.embodiment import Option
from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import counted
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.policy.scheduler import Act, Read, Scheduler

WINDOW = 2048  # latest durations kept of each kind


class ServerStats:
    """Counts since the start, and percentiles over the latest `WINDOW` durations of each kind."""

    def __init__(self) -> None:
        self._begun = time.monotonic()
        self._seconds: dict[str, deque[float]] = defaultdict(lambda: deque(maxlen=WINDOW))
        self.counts: Counter[str] = Counter()

    def took(self, kind: str, seconds: float) -> None:
        self.counts[kind] += 1
        self._seconds[kind].append(seconds)

    def percentiles(self, kind: str) -> dict[str, float] | None:
        """p50, p95 and the longest in milliseconds, or None before the first."""
        seconds = self._seconds.get(kind)
        if not seconds:
            return None
        p50, p95 = np.percentile(np.fromiter(seconds, float), [50, 95])
        return {
            "p50": round(p50 * 1e3, 2),
            "p95": round(p95 * 1e3, 2),
            "max": round(max(seconds) * 1e3, 2),
        }

    def snapshot(self, n_clients: int) -> dict[str, Any]:
        mean_batch = None
        if self.counts["batch"]:
            mean_batch = round(self.counts["batched"] / self.counts["batch"], 2)
        return {
            "uptime_s": round(time.monotonic() - self._begun, 1),
            "connections": n_clients,
            "counts": dict(sorted(self.counts.items())),
            "mean_batch": mean_batch,
            "latency_ms": {kind: self.percentiles(kind) for kind in sorted(self._seconds)},
        }

    def line(self, n_clients: int) -> str:
        """One line for the log."""
        times = "none yet"
        infer = self.percentiles("infer")
        if infer:
            times = f"p50 {infer['p50']:.0f} ms, p95 {infer['p95']:.0f} ms"
        mean = self.snapshot(n_clients)["mean_batch"]
        if mean:
            times += f", {mean} to a batch"
        return (
            f"{counted(n_clients, 'client')} · {counted(self.counts['infer'], 'inference')}"
            f" ({times}) · "
            f"{counted(self.counts['refused'], 'request')} refused, {self.counts['failed']} failed"
        )


logger = logging.getLogger("mme_vla.serving")


@dataclass(eq=False)
class _Waiting[T]:
    """A piece of work and its future, which is done already if the client has left.

    pieces: those still to be run; 0 once it is done or its client has left.
    """

    work: T
    pieces: int = 1
    future: asyncio.Future = field(
        default_factory=lambda: asyncio.get_running_loop().create_future()
    )


class Engine:
    """Runs the policy for all clients.

    The event loop never computes. All computing happens in one thread, in the order of
    `mme_vla.policy.scheduler`.

    Args:
        policy: with statistics, on its device.
        max_batch: most episodes that act together.
        flow_steps: of the sampler, for a chunk; None for the policy's own.
    """

    def __init__(
        self,
        policy: Policy,
        max_batch: int = 16,
        flow_steps: int | None = None,
        stats: ServerStats | None = None,
    ) -> None:
        self.policy = policy
        self.flow_steps = flow_steps
        self.stats = stats or ServerStats()
        self.scheduler: Scheduler[_Waiting[Iterator[None]], _Waiting[Episode], Episode] = Scheduler(
            max_batch
        )
        self._wake = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, "policy")

    async def warm_up(self, n_frames: int) -> None:
        """Encode a piece of video and choose chunks, alone and as a pair; nothing of it is kept."""
        n_episodes = min(2, self.scheduler.max_batch)
        await self.call(lambda: _try_out(self.policy, n_episodes, n_frames, self.flow_steps))

    def start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._work())

    async def stop(self) -> None:
        """Stop after the piece that is running; what still waits is cancelled."""
        self._task.cancel()
        with suppress(asyncio.CancelledError):
            await self._task
        for acting in self.scheduler.acting:
            acting.future.cancel()
        for reading in self.scheduler.reading:
            reading.future.cancel()
        await asyncio.to_thread(self._thread.shutdown)

    async def act(self, episode: Episode) -> np.ndarray:
        """The next chunk [h, w] of an episode, in one batch with all episodes that wait at the same
        time.
        """
        waiting = _Waiting(episode)
        self.scheduler.acting.append(waiting)
        self._wake.set()
        chunk: np.ndarray = await waiting.future
        return chunk

    async def run(self, steps: Iterator[None], pieces: int = 1) -> None:
        """Run an iterator that pauses between its `pieces` in the policy's thread, with others'
        work in the pauses.
        """
        waiting = _Waiting(steps, pieces)
        self.scheduler.reading.append(waiting)
        self._wake.set()
        await waiting.future

    async def call[T](self, function: Callable[[], T]) -> T:
        """Run something short in the policy's thread, at once."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def _work(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self.scheduler:
                await self._run_round()

    async def _run_round(self) -> None:
        """A function of its own, so that nothing holds the last episode while nothing waits."""
        for step in self.scheduler.next_steps():
            if isinstance(step, Read):
                await self._piece(step.work)
                await asyncio.sleep(0)  # clients whose frames are in request actions now
            elif isinstance(step, Act):
                await self._batch(step.batch)
            else:
                await self._prepare(step.work)

    async def _batch(self, batch: list[_Waiting[Episode]]) -> None:
        batch = [waiting for waiting in batch if not waiting.future.done()]
        if not batch:
            return
        begun = time.perf_counter()
        chunks = await self.call(lambda: self._act([waiting.work for waiting in batch]))
        self.stats.took("batch", time.perf_counter() - begun)
        self.stats.counts["batched"] += len(batch)
        for waiting, chunk in zip(batch, chunks, strict=True):
            if waiting.future.done():
                continue
            if isinstance(chunk, Exception):
                waiting.future.set_exception(chunk)
            else:
                waiting.future.set_result(chunk)
                self.scheduler.later[waiting.work] = None

    async def _prepare(self, episode: Episode) -> None:
        """A piece of what a client's next request will need, while its robot moves."""
        try:
            left = await self.call(lambda: self.policy.prepare(episode))
        except Exception:
            logger.exception(
                "preparing an episode's next chunk failed; it will be computed on request"
            )
            return
        if left:
            self.scheduler.later[episode] = None

    def _act(self, episodes: list[Episode]) -> list[np.ndarray | Exception]:
        """Chunks [h, w], or why there is none. Where a batch fails each is tried alone, so that
        none fails another.
        """
        noise = [episode.noise_state for episode in episodes]
        try:
            return list(self.policy.act(episodes, self.flow_steps))
        except Exception as error:
            if len(episodes) == 1:
                return [error]
        for episode, state in zip(episodes, noise, strict=True):
            episode.noise_state = state  # the same actions as if it had been alone from the start
        chunks: list[np.ndarray | Exception] = []
        for episode in episodes:
            chunks += self._act([episode])
        return chunks

    async def _piece(self, waiting: _Waiting[Iterator[None]]) -> None:
        if waiting.future.done():
            waiting.pieces = 0
            return
        try:
            finished = await self.call(lambda: next(waiting.work, _END)) is _END
        except Exception as error:
            waiting.pieces = 0
            if not waiting.future.done():
                waiting.future.set_exception(error)
            return
        if not finished:
            waiting.pieces = max(1, waiting.pieces - 1)
            return
        waiting.pieces = 0
        if not waiting.future.done():
            waiting.future.set_result(None)


def _try_out(policy: Policy, n_episodes: int, n_frames: int, flow_steps: int | None) -> None:
    robot = policy.embodiment
    # Black images of every camera, and a wall at no distance where it reads depth.
    frames: dict[str, np.ndarray] = {}
    for camera in robot.cameras:
        frames[camera.name] = np.zeros((n_frames, SIDE, SIDE, 3), np.uint8)
        if camera.depth:
            depth_name, pose_name = camera.readings
            frames[depth_name] = np.zeros((n_frames, SIDE, SIDE, 1), np.float32)
            frames[pose_name] = np.tile(np.eye(3, 4, dtype=np.float32), (n_frames, 1, 1))
    episodes = [policy.start_episode("warm up") for _ in range(n_episodes)]
    for episode in episodes:
        episode.subgoal = "warm up"
        episode.options = (Option("a", "warm up"),)
        episode.observe(frames, np.zeros((n_frames, robot.state.width), np.float32))
    policy.act(episodes[:1], flow_steps)
    policy.act(episodes, flow_steps)


_END = object()
