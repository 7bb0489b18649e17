"""Runs commands of the library as a user's shell would, but for their imports: each is a fork of one process that has
imported PyTorch, LeRobot and the simulator once. Seconds of CPU time are saved for every command a test runs.

Tests of what happens while a command is imported, or of process groups, start real processes.
"""

import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing import forkserver
from pathlib import Path

from conftest import REPOSITORY

from mme_vla.envs.vector import worker


class Command:
    """What `python -W ignore -m <words>` is, started in a folder with these environment variables besides the own.

    Args:
        words: a module, or a file that ends with `.py`, and its arguments.
        hidden: modules that do not exist for it.
    """

    def __init__(
        self,
        *words: str,
        cwd: Path = REPOSITORY,
        env: Mapping[str, str] | None = None,
        hidden: Sequence[str] = (),
    ) -> None:
        self._words = list(words)
        self._folder = tempfile.TemporaryDirectory()
        self._printed = [Path(self._folder.name, name) for name in ("out", "err")]
        arguments = (words, cwd, hidden, *self._printed)
        self.process = worker.simulating_processes().Process(
            target=worker.begin, args=({**os.environ, **(env or {})}, _be, *arguments)
        )
        self.process.start()

    @property
    def errors(self) -> str:
        """What it has printed as errors up to now."""
        return self._printed[1].read_text() if self._printed[1].exists() else ""

    def finish(self, timeout: float = 280.0) -> "subprocess.CompletedProcess[str]":
        """Wait for its end; one that takes longer than `timeout` seconds is killed, and an error."""
        self.process.join(timeout)
        late = self.process.exitcode is None
        if late:
            self.process.kill()
            self.process.join()
        out, err = (path.read_text() if path.exists() else "" for path in self._printed)
        self._folder.cleanup()
        if late:
            raise subprocess.TimeoutExpired(self._words, timeout, out, err)
        return subprocess.CompletedProcess(self._words, self.process.exitcode, out, err)


def run(
    *words: str,
    cwd: Path = REPOSITORY,
    env: Mapping[str, str] | None = None,
    hidden: Sequence[str] = (),
    timeout: float = 280.0,
) -> "subprocess.CompletedProcess[str]":
    """How a command ended, and what it printed; arguments as for `Command`."""
    return Command(*words, cwd=cwd, env=env, hidden=hidden).finish(timeout)


def _be(words: Sequence[str], cwd: Path, hidden: Sequence[str], out: Path, err: Path) -> None:
    os.chdir(cwd)
    for path, number in ((out, 1), (err, 2)):
        with path.open("wb") as file:
            os.dup2(file.fileno(), number)
    if hidden:  # some may be imported here: begin anew, without them
        extras = str(Path(__file__).parent / "extras")
        variables = {"HIDDEN_MODULES": " ".join(hidden), "PYTHONPATH": os.pathsep.join([extras, str(REPOSITORY)])}
        command = [sys.executable, "-W", "ignore", *([] if words[0].endswith(".py") else ["-m"]), *words]
        os.execve(sys.executable, command, os.environ | variables)
    # Its workers are forked from where it was; Python 3.12 would import everything once more for them.
    forkserver._forkserver.ensure_running = lambda: None  # type: ignore[method-assign]
    sys.path.insert(0, str(cwd))
    sys.argv = list(words)
    if words[0].endswith(".py"):
        sys.path.insert(0, str(Path(words[0]).resolve().parent))
        runpy.run_path(words[0], run_name="__main__")
    else:
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
