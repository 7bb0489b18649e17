"""Processes that simulate: how they start and end, and how messages travel.

They start quickly and inherit only the settings of the process that starts them. What a worker of a
`VecEnv` does is `serve` in `pool.py`.
"""

import gc
import multiprocessing
import os
import pickle
import sysconfig
import traceback
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any

from mme_vla import errors
from mme_vla.config.plugins import import_plugins, imported_plugins
from mme_vla.utils.processes import GUARD, UNGUARDED, end_with_parent

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


def settings() -> tuple[dict[str, str], Sequence[str]]:
    """What a process is to `begin` with: environment variables, and plugins."""
    return dict(os.environ), imported_plugins()


def begin(variables: Mapping[str, str], plugins: Sequence[str]) -> None:
    """Take the `settings` of the process that started this one, and end with it."""
    gc.freeze()  # what a collection does not walk through stays shared between the processes
    os.environ.clear()
    os.environ.update(variables)
    end_with_parent()
    import_plugins(plugins)


_INSTALLED = (
    Path(errors.__file__).parent,
    *(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
)
"""Folders of code that is no plugin's, but for packages that are plugins."""
# Messages from a worker: the outcome of a command, or what it raised.
RESULT, FAILURE = "result", "failure"
# Commands to a worker.
RESET, STEP, CLOSE = "reset", "step", "close"


def send(connection: Any, *message: Any) -> None:
    """Send a message."""
    # A plain pickle, so that tensors travel by value and not as file descriptors.
    connection.send_bytes(pickle.dumps(message, pickle.HIGHEST_PROTOCOL))


def receive(connection: Any) -> tuple:
    """Receive what `send` sent."""
    return pickle.loads(connection.recv_bytes())


def portable(error: Exception) -> Exception:
    """The error, or a RuntimeError of its text if the reader would have to import its class."""
    place = None  # the innermost code of a plugin that the error passed
    for frame, line in traceback.walk_tb(error.__traceback__):
        if _is_of_plugin(frame):
            place = f"{frame.f_code.co_filename}, line {line}"
    portable: Exception = RuntimeError(f"{type(error).__name__}: {error}")
    if type(error).__module__ in ("builtins", errors.__name__):
        with suppress(Exception):  # its arguments may not survive the way
            pickle.loads(pickle.dumps(error))
            portable = error
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


def last_words(process: Any) -> str:
    """How a process ended.

    Raises:
        UserError: it imported a script that would have started workers again.
    """
    process.join(1.0)
    code = process.exitcode
    if code == UNGUARDED:
        raise errors.UserError(GUARD) from None
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
