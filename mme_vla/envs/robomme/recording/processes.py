"""Work that simulates, in processes of its own."""

import gc
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed

from mme_vla.envs.vector.worker import begin, settings, simulating_processes
from mme_vla.utils.processes import signals_deferred


def carry_out[J, R](jobs: Sequence[J], work: Callable[[J], R], workers: int) -> Iterator[R]:
    """Do work that simulates, in so many processes; yields each result when it is there.

    work: importable by name, or a partial of such, where there are several processes.
    """
    if workers == 1 or len(jobs) < 2:
        import mme_vla.envs.task  # noqa: F401

        # scenes are built faster when no collection walks through the simulator's modules
        gc.freeze()
        yield from map(work, jobs)
        return
    with simulation_pool(workers) as pool:
        with signals_deferred():  # the workers are started here, and inherit that
            futures = [pool.submit(work, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            if isinstance(error, KeyboardInterrupt):  # an episode takes minutes: it is not awaited
                for worker in multiprocessing.active_children():
                    worker.terminate()
            raise


def simulation_pool(workers: int) -> ProcessPoolExecutor:
    """Processes that simulate, end with this one, and know the same plugins."""
    return ProcessPoolExecutor(workers, simulating_processes(), begin, settings())
