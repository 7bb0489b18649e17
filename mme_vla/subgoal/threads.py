"""Calls in daemon threads, which do not keep an interrupted process alive."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from multiprocessing.pool import ThreadPool
from typing import cast


def start[T](call: Callable[[], T]) -> Future[T]:
    """Begin a call in a thread of its own."""
    future: Future[T] = Future()

    def work() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=work, name="subgoals", daemon=True).start()
    return future


def side_by_side[A, T](call: Callable[[A], T], items: Sequence[A], workers: int) -> list[T]:
    """Call with each of one or more items, `workers` at a time; results in the items' order.

    Raises:
        Exception: of the first item that failed. No further call begins then.
    """
    failed = threading.Event()

    def guarded(item: A) -> T | None:
        if failed.is_set():
            return None  # the error of an earlier item is raised
        try:
            return call(item)
        except BaseException:
            failed.set()
            raise

    with ThreadPool(min(workers, len(items))) as pool:
        return cast(list[T], list(pool.imap(guarded, items)))
