"""Making the next things while the last are used."""

import queue
import threading
from collections.abc import Generator, Iterable
from typing import Any

_END = object()


def ahead[T](things: Iterable[T], count: int) -> Generator[T, None, None]:
    """The same things, made in a thread up to `count` ahead; what goes wrong there is raised where they are used.

    Closing the generator ends the thread.
    """
    made: queue.Queue[Any] = queue.Queue(count)
    closed = threading.Event()

    def put(thing: Any) -> bool:
        while not closed.is_set():
            try:
                made.put(thing, timeout=0.1)
                return True
            except queue.Full:
                continue
        return False

    def make() -> None:
        try:
            for thing in things:
                if not put((thing, None)):
                    return
            put((_END, None))
        except BaseException as error:
            put((_END, error))

    thread = threading.Thread(target=make, name="ahead", daemon=True)
    thread.start()
    try:
        while True:
            thing, error = made.get()
            if error is not None:
                raise error
            if thing is _END:
                return
            yield thing
    finally:
        closed.set()
        thread.join()
