"""Runs commands of the library as a user's shell would, but for their imports: each is a fork of one process that has
imported PyTorch, LeRobot and the simulator once. Seconds of CPU time are saved for every command a test runs.

Tests of what happens while a command is imported, or when it is killed, start real processes.
"""

import importlib
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from conftest import REPOSITORY

from mme_vla.envs.vector import processes


def run(
    *words: str,
    cwd: Path = REPOSITORY,
    env: Mapping[str, str] | None = None,
    hidden: Sequence[str] = (),
    timeout: float = 280.0,
):
    """What `python -W ignore -m <words>` would end as in a folder, with these environment variables besides the own.

    Args:
        hidden: modules that do not exist for it.

    Returns:
        A `subprocess.CompletedProcess` with text.
    """
    with tempfile.TemporaryDirectory() as folder:
        out, err = Path(folder, "out"), Path(folder, "err")
        variables = {**os.environ, **(env or {})}
        process = processes.simulating_processes().Process(
            target=processes.begin, args=(variables, _be, words, cwd, hidden, out, err)
        )
        process.start()
        process.join(timeout)
        if process.exitcode is None:
            process.kill()
            process.join()
            raise subprocess.TimeoutExpired(list(words), timeout, out.read_bytes(), err.read_bytes())
        return subprocess.CompletedProcess(list(words), process.exitcode, out.read_text(), err.read_text())


def script(path: Path, *words: str, **how):
    """The same for `python <path> <words>`."""
    return run(str(path), *words, **how)


def _be(words: Sequence[str], cwd: Path, hidden: Sequence[str], out: Path, err: Path) -> None:
    if hidden:
        assert not set(hidden) & set(sys.modules), "these are imported already"
        os.environ["HIDDEN_MODULES"] = " ".join(hidden)
        sys.path.insert(0, str(Path(__file__).parent / "extras"))
        importlib.import_module("sitecustomize")
    os.chdir(cwd)
    sys.path[0:0] = [str(cwd)]
    for path, number in ((out, 1), (err, 2)):
        with path.open("wb") as file:
            os.dup2(file.fileno(), number)
    sys.argv = list(words)
    if words[0].endswith(".py"):
        runpy.run_path(words[0], run_name="__main__")
    else:
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
