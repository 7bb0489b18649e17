"""Calls in threads that never keep the process alive: after an interrupt nobody waits for a model's answer."""

import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import partial


def start[T](call: Callable[[], T]) -> Future[T]:
    """Begin a call in a thread of its own."""
    future: Future[T] = Future()
    threading.Thread(target=_fill, args=(future, call), name="subgoals", daemon=True).start()
    return future


def within[T](seconds: float, call: Callable[[], T]) -> T:
    """Call, waiting no longer than that; a call that hangs is left behind in its thread.

    Raises:
        TimeoutError: it took longer. Exception: what the call raised.
    """
    future = start(call)
    try:
        return future.result(seconds)
    except TimeoutError:
        if future.done():  # the call's own
            raise
        raise TimeoutError(f"no answer within {seconds:g} s") from None


def side_by_side[A, T](call: Callable[[A], T], items: Sequence[A], workers: int) -> list[T]:
    """Call with each item, so many at a time; the results in the items' order.

    Raises:
        Exception: what the first item that failed raised; no further call is begun then.
    """
    waiting: queue.SimpleQueue[tuple[Future[T], A]] = queue.SimpleQueue()
    futures: list[Future[T]] = [Future() for _ in items]
    for pair in zip(futures, items, strict=True):
        waiting.put(pair)
    stopped = threading.Event()

    def work() -> None:
        while not stopped.is_set():
            try:
                future, item = waiting.get_nowait()
            except queue.Empty:
                return
            _fill(future, partial(call, item))
            if future.exception() is not None:
                stopped.set()  # what comes after it in the queue is never looked at

    for _ in range(min(workers, len(items))):
        threading.Thread(target=work, name="subgoals", daemon=True).start()
    try:
        return [future.result() for future in futures]
    finally:
        stopped.set()


def _fill[T](future: Future[T], call: Callable[[], T]) -> None:
    try:
        future.set_result(call())
    except BaseException as error:  # whoever waits for the result gets it
        future.set_exception(error)
