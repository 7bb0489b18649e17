"""Worker processes that end with the process that started them, however that ends, and leave Ctrl-C
to it.
"""

import multiprocessing
import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.connection import wait

from mme_vla.errors import ERROR, brief, require

UNGUARDED = os.EX_CONFIG
"""Exit code of a worker process that would start workers of its own when it imports the script."""
GUARD = (
    "A worker process imports this script once more, and it starts workers again: keep what it does"
    ' under `if __name__ == "__main__":`.'
)


def check_main_guard() -> None:
    """End a worker process that imports the script whose workers it is one of."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        print(f"{ERROR}{GUARD}", file=sys.stderr, flush=True)
        os._exit(UNGUARDED)  # the process that started this one raises the error (`last_words`)


def end_with_parent() -> None:
    """Called first in a worker: it ends as soon as its parent is gone, even a killed one, and
    ignores Ctrl-C.

    Ctrl-C goes to every process of a terminal; the parent alone handles it, and ends its workers.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is None:
        return
    # The process that forked this one: the parent itself, or its fork server, which ends when the
    # parent does.
    watched, number = [parent.sentinel], os.getppid()

    def watch() -> None:
        # Forked sisters hold each other's ends of the pipe, so that number is looked at as well.
        while not wait(watched, timeout=1.0) and os.getppid() == number:
            pass
        os._exit(1)  # nothing to tidy up for anybody, and a simulator may take long to

    threading.Thread(target=watch, name="parent watch", daemon=True).start()


@contextmanager
def signals_deferred() -> Iterator[None]:
    """While this is open, Ctrl-C waits; processes that are started meanwhile never see it, so that
    they can be young.

    A process that is still importing would otherwise answer with a traceback.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


_OTHERS = 256  # descriptors that libraries, workers and sockets need besides


def files_to_hold(limit: int) -> int:
    """How many of `limit` files may be held open: all, where the system lets this process raise its
    own limit.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = limit + _OTHERS
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return limit
    if hard != resource.RLIM_INFINITY:
        needed = min(needed, hard)
    soft = max(soft, needed)
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return min(limit, max(soft - _OTHERS, 8))


def started_processes(environment: Mapping[str, str] | None = None) -> int:
    """How many processes a launcher, such as torchrun, started this one among; 1 without a
    launcher.

    Args:
        environment: variables; by default the process's own.

    Raises:
        UserError: WORLD_SIZE is no count, or `accelerate launch --cpu` was asked for several
            processes. It starts one where it has no MPI.
    """
    variables = os.environ if environment is None else environment
    world = variables.get("WORLD_SIZE", "1")
    require(
        world.isdecimal() and int(world) >= 1,
        f"WORLD_SIZE={brief(world)} is no count of processes.",
    )
    on_cpu = variables.get("ACCELERATE_USE_CPU", "").lower() in ("1", "true", "yes")
    by_mpi = any(name in variables for name in _MPI)
    # Accelerate names the meeting point alone where more than one process was asked for.
    require(
        "WORLD_SIZE" in variables or by_mpi or not (on_cpu and "MASTER_ADDR" in variables),
        "accelerate launch --cpu was asked for several processes and started one, since it needs"
        " MPI for more. Start them with torchrun --nproc-per-node <processes> -m mme_vla.train …,"
        " or leave --num_processes out.",
    )
    return int(world)


_MPI = ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE", "MV2_COMM_WORLD_SIZE")
"""Variables by which MPI counts the processes that it started."""
