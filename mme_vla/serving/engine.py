"""The one thread that runs the policy: waiting requests travel in one batch, long videos in pieces between batches."""

import asyncio
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from mme_vla.policy.episode import Episode
from mme_vla.policy.mme import MMEPolicy
from mme_vla.serving.counters import ServerStats


@dataclass(eq=False)
class _Waiting[T]:
    """A piece of work and who waits for it; a future that is done already belongs to a client that has gone."""

    work: T
    future: asyncio.Future
    pieces: int = 1


class Engine:
    """Runs the policy for all clients.

    The event loop never computes. All computing happens in one thread, which takes turns: the new frames of everyone
    who has only a few, then one batch of the episodes that wait for actions, then pieces of long videos for as long as
    the rest of the turn took, at least one piece. So clients that replan at the same time travel together, and clients
    with a thousand frames and clients with few each get half of the machine while there are both.

    Args:
        policy: with statistics, on its device.
        max_batch: most episodes that act together.
        flow_steps: Euler steps a chunk.
    """

    def __init__(self, policy: MMEPolicy, max_batch: int = 16, flow_steps: int = 10, stats: ServerStats | None = None):
        self.policy = policy
        self.max_batch, self.flow_steps = max_batch, flow_steps
        self.stats = stats or ServerStats()
        self._acts: deque[_Waiting[Episode]] = deque()
        self._videos: deque[_Waiting[Iterator[None]]] = deque()
        self._wake = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, "policy")
        self._readers = ThreadPoolExecutor(2, "decode")
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to work, in the running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._work())

    async def stop(self) -> None:
        """Stop after the piece that is running; what still waits is cancelled."""
        if self._task is not None:
            self._task.cancel()
            with suppress(asyncio.CancelledError):
                await self._task
        for future in [*(w.future for w in self._acts), *(w.future for w in self._videos)]:
            future.cancel()
        self._readers.shutdown(wait=False)
        await asyncio.to_thread(self._thread.shutdown)

    async def act(self, episode: Episode) -> np.ndarray:
        """The next chunk [h, w] of an episode, chosen in one batch with whoever waits at the same time."""
        chunk: np.ndarray = await self._join(self._acts, episode)
        return chunk

    async def run(self, steps: Iterator[None], pieces: int = 1) -> None:
        """Run an iterator that pauses between its `pieces` in the policy's thread, with others' work in the pauses."""
        await self._join(self._videos, steps, pieces)

    async def call(self, function: Callable[[], object]) -> object:
        """Run something short in the policy's thread, at once."""
        return await asyncio.get_running_loop().run_in_executor(self._thread, function)

    async def decode[T](self, function: Callable[[], T]) -> T:
        """Run something that decodes a large message, beside the policy's thread."""
        return await asyncio.get_running_loop().run_in_executor(self._readers, function)

    async def _join[T](self, queue: deque[_Waiting[T]], work: T, pieces: int = 1) -> np.ndarray:
        future: asyncio.Future[np.ndarray] = asyncio.get_running_loop().create_future()
        queue.append(_Waiting(work, future, pieces))
        self._wake.set()
        return await future

    async def _work(self) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._acts or self._videos:
                begun = time.perf_counter()
                for waiting in [waiting for waiting in self._videos if waiting.pieces <= 1][: self.max_batch]:
                    await self._piece(waiting)
                await asyncio.sleep(0)  # those whose frames are in now ask for actions
                if self._acts:
                    await self._batch()
                until = 2 * time.perf_counter() - begun
                while long := next((waiting for waiting in self._videos if waiting.pieces > 1), None):
                    await self._piece(long)
                    if time.perf_counter() > until:
                        break

    async def _batch(self) -> None:
        batch: list[_Waiting[Episode]] = []
        while self._acts and len(batch) < self.max_batch:
            waiting = self._acts.popleft()
            if not waiting.future.done():
                batch.append(waiting)
        if not batch:
            return
        begun = time.perf_counter()
        try:
            chunks = await self.call(lambda: self.policy.act([waiting.work for waiting in batch], self.flow_steps))
        except Exception as error:
            for waiting in batch:
                _fail(waiting.future, error)
            return
        self.stats.took("batch", time.perf_counter() - begun)
        self.stats.count("batched", len(batch))
        assert isinstance(chunks, np.ndarray)
        for waiting, chunk in zip(batch, chunks, strict=True):
            if not waiting.future.done():
                waiting.future.set_result(chunk)

    async def _piece(self, waiting: _Waiting[Iterator[None]]) -> None:
        self._videos.remove(waiting)
        if waiting.future.done():
            return
        try:
            finished = await self.call(lambda: next(waiting.work, _END)) is _END
        except Exception as error:
            return _fail(waiting.future, error)
        if not finished:
            waiting.pieces -= 1
            return self._videos.append(waiting)
        if not waiting.future.done():
            waiting.future.set_result(None)
        return None


_END = object()


def _fail(future: asyncio.Future, error: Exception) -> None:
    if not future.done():
        future.set_exception(error)
