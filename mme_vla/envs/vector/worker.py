"""Processes that simulate: how they start and end, and how messages and frames travel.

They start quickly and inherit only the settings of the process that starts them. What a worker of a
`VecEnv` does is `serve` in `pool.py`.
"""

import gc
import multiprocessing
import os
import pickle
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from mme_vla import errors
from mme_vla.config.plugins import imported_plugins
from mme_vla.envs.rendering import renderer_works

PRELOADED = ["mme_vla.envs.task"]
"""Modules that simulating processes import before they begin; fixed when the first of them is
started.
"""


def simulating_processes() -> Any:
    """The context of `multiprocessing` in which processes that simulate are started."""
    # Forked from one process that has only imported the simulator and holds no GPU and no renderer,
    # each saves 5 s of CPU time. Its environment variables may be out of date: `begin` renews them.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


def settings() -> dict[str, str]:
    """The environment variables that a process is to begin with."""
    return dict(os.environ)


def begin(variables: Mapping[str, str], work: Callable[..., Any], *arguments: Any) -> Any:
    """Take the environment variables of the process that started this one, then do its work."""
    gc.freeze()  # what a collection does not walk through stays shared between the processes
    os.environ.clear()
    os.environ.update(variables)
    return work(*arguments)


_INSTALLED = (
    Path(errors.__file__).parent,
    *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
)
"""Folders of code that is no plugin's, but for packages that are plugins."""
LARGE = 4096
"""Arrays of at least this many bytes go through shared memory; everything else is pickled."""
FRAMES_PER_BLOCK = 8
BLOCK_BYTES = FRAMES_PER_BLOCK * 2 * 256 * 256 * 3
"""Shared memory of one worker: long videos are handed over in pieces of this size."""

# Messages from a worker. PIECE: the arrays described lie in the block, and the worker waits for any
# reply. RESULT: the outcome of a command. FAILURE: the command raised. LOST: it raised, and the
# process is of no further use.
PIECE, RESULT, FAILURE, LOST = "piece", "result", "failure", "lost"
# Commands to a worker.
RESET, STEP, CLOSE, CONTINUE = "reset", "step", "close", "continue"


@dataclass(frozen=True)
class Placed:
    """Replaces an array of a message that came through shared memory: the n-th of the message."""

    index: int


@dataclass(frozen=True)
class Slot:
    """Position of one array in the block."""

    offset: int
    shape: tuple[int, ...]
    dtype: str


def send(connection: Any, *message: Any) -> None:
    """Send a message."""
    # A plain pickle, so that tensors travel by value and not as file descriptors.
    connection.send_bytes(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))


def receive(connection: Any) -> tuple:
    """Receive what `send` sent."""
    return pickle.loads(connection.recv_bytes())


def read(block: Any, slots: list[Slot]) -> list[np.ndarray]:
    """Copies of the arrays that lie in a block."""
    arrays = []
    for slot in slots:
        array = np.frombuffer(block, slot.dtype, int(np.prod(slot.shape)), slot.offset)
        arrays.append(array.reshape(slot.shape).copy())
    return arrays


def restore(value: Any, arrays: list[np.ndarray]) -> Any:
    """Put the arrays back in place of `Placed`."""
    if isinstance(value, Placed):
        return arrays[value.index]
    if isinstance(value, dict):
        return {key: restore(item, arrays) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(restore(item, arrays) for item in value)
    return value


def send_error(connection: Any, error: Exception) -> bool:
    """Send what a command raised; return whether the process is of further use."""
    is_usable: bool = renderer_works()
    send(connection, FAILURE if is_usable else LOST, _portable(error))
    return is_usable


def _portable(error: Exception) -> Exception:
    """The error, or a RuntimeError of its text if the reader would have to import its class."""
    place = None  # the innermost code of a plugin that the error passed
    for frame, line in traceback.walk_tb(error.__traceback__):
        if _is_of_plugin(frame):
            place = f"{frame.f_code.co_filename}, line {line}"
    portable: Exception = RuntimeError(f"{type(error).__name__}: {error}")
    if type(error).__module__ in ("builtins", errors.__name__):
        try:
            pickle.loads(pickle.dumps(error))
            portable = error
        except Exception:
            pass  # its arguments do not survive the way
    if place is not None and not isinstance(error, errors.UserError | errors.SceneError):
        errors.set_place(portable, f"{type(error).__name__}, {place}")
    return portable


def _is_of_plugin(frame: FrameType) -> bool:
    name = str(frame.f_globals.get("__name__", ""))
    packages = {module.partition(".")[0] for module in imported_plugins()}
    if name.partition(".")[0] in packages:
        return True
    file = frame.f_code.co_filename
    if file.startswith("<"):
        return False
    return not any(Path(file).is_relative_to(folder) for folder in _INSTALLED)


def hand_over(connection: Any, block: Any, outcome: Any) -> None:
    """Send the outcome of a command: its large arrays piece by piece through the block, then the
    rest.
    """
    large: list[np.ndarray] = []
    light = _lift(outcome, large)
    for slots in _pieces(block, large):
        send(connection, PIECE, slots)
        receive(connection)
    send(connection, RESULT, light)


def _lift(value: Any, large: list[np.ndarray]) -> Any:
    """Take the large arrays out of a nested value."""
    is_array = isinstance(value, np.ndarray) and value.dtype != object
    if is_array and LARGE <= value.nbytes <= BLOCK_BYTES:
        large.append(value)
        return Placed(len(large) - 1)
    if isinstance(value, dict):
        return {key: _lift(item, large) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(_lift(item, large) for item in value)
    return value


def _pieces(block: Any, arrays: list[np.ndarray]) -> Iterator[list[Slot]]:
    """Fill the block with as many arrays as it holds, again and again."""
    memory = np.frombuffer(block, np.uint8)
    slots: list[Slot] = []
    used = 0
    for array in arrays:
        size = -(-array.nbytes // 64) * 64
        if used + array.nbytes > len(memory):
            yield slots
            slots, used = [], 0
        memory[used : used + array.nbytes] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
        slots.append(Slot(used, array.shape, array.dtype.str))
        used += size
    if slots:
        yield slots


def last_words(process: Any) -> str:
    """How a process ended."""
    process.join(1.0)
    code = process.exitcode
    if code is not None and code < 0:
        return f"died of signal {-code}"
    return f"ended with exit code {code}"


def end(process: Any) -> None:
    """Stop a process, by force if need be."""
    if process.is_alive():
        process.terminate()
        process.join(1.0)
    if process.is_alive():
        process.kill()
        process.join()
    process.close()
