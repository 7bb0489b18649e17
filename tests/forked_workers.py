"""Test workers of pytest-xdist that are forks of one process, which has imported and collected the tests.

Started as usual, each would import PyTorch, the simulator and 250 files of tests for itself: 20 s of CPU time. What
pytest-xdist starts is this file: it hands its input and output to a fork, and waits for the fork's end.
"""

import contextlib
import gc
import os
import select
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any


class Collected:
    """The process that is forked.

    Args:
        places: files, folders and tests, as pytest was given them in `folder`.
    """

    def __init__(self, places: Sequence[str], folder: Path) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self._address = str(Path(self._folder.name, "socket"))
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(self._address)
            listener.listen(64)
            words = [sys.executable, __file__, "collect", str(listener.fileno()), *places]
            # It ends with its input, whatever ends this process.
            self._process = subprocess.Popen(words, stdin=subprocess.PIPE, cwd=folder, pass_fds=[listener.fileno()])

    @property
    def python(self) -> str:
        """What pytest-xdist is to start in place of Python."""
        return shlex.join([sys.executable, "-I", __file__, "wait", self._address])

    def end(self) -> None:
        """Let it end; workers do not depend on it."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()


def collect(listener: socket.socket, places: Sequence[str]) -> None:
    """Collect the tests, then fork a worker for each connection, until the input ends."""
    import pytest

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with (
        Path(os.devnull).open("w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        # What cannot be imported is a worker's to say, which tries again.
        pytest.main(["--collect-only", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", *places])
    gc.collect()
    gc.freeze()
    # The one other thread is that of PyArrow's allocator, which prepares for forks.
    warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
    while listener in select.select([listener, sys.stdin], [], [])[0]:
        connection, _ = listener.accept()
        _, given, _, _ = socket.recv_fds(connection, 1, 3)
        if os.fork() == 0:
            listener.close()
            work(given)
            os._exit(0)
        for number in (*given, connection.detach()):
            os.close(number)


def work(given: Sequence[int]) -> None:
    """Be what `python -u -c <execnet's first line>` is, with these files as its input, output and errors."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, file in enumerate(given):
        os.dup2(file, number)
        os.close(file)
    sys.stdin = os.fdopen(0, "r", closefd=False)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
    names: dict[str, Any] = {"__name__": "__main__", "sys": sys}
    exec(eval(sys.stdin.readline()), names)


def wait(address: str) -> None:
    """Hand input, output and errors to a new worker, and wait for its end."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(address)
        socket.send_fds(connection, [b"\0"], [0, 1, 2])
        connection.recv(1)


if __name__ == "__main__":
    if sys.argv[1] == "wait":
        wait(sys.argv[2])
    else:
        collect(socket.socket(fileno=int(sys.argv[2])), sys.argv[3:])
