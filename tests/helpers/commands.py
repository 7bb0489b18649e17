"""Commands of the library in fresh processes, as a shell starts them."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from helpers import REPOSITORY


def start(
    *words: str,
    cwd: Path = REPOSITORY,
    env: Mapping[str, str] | None = None,
    stderr: Any = subprocess.PIPE,
) -> "subprocess.Popen[str]":
    """Start a module, or a file that ends with `.py`, with arguments and additional environment
    variables.
    """
    command = [
        sys.executable,
        "-W",
        "ignore",
        *([] if words[0].endswith(".py") else ["-m"]),
        *words,
    ]
    path = os.pathsep.join([str(REPOSITORY), str(REPOSITORY / "tests")])
    variables = {**os.environ, "PYTHONPATH": path, **(env or {})}
    return subprocess.Popen(
        command, cwd=cwd, env=variables, stdout=subprocess.PIPE, stderr=stderr, text=True
    )


def finish(
    process: "subprocess.Popen[str]", timeout: float = 1500.0
) -> "subprocess.CompletedProcess[str]":
    """Exit code and output of a process. One that takes longer than `timeout` seconds is killed,
    and an error.
    """
    with process:
        try:
            output, errors = process.communicate(timeout=timeout)
        finally:
            process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


def run(
    *words: str,
    cwd: Path = REPOSITORY,
    env: Mapping[str, str] | None = None,
    timeout: float = 1500.0,
) -> "subprocess.CompletedProcess[str]":
    """Run a command to its end."""
    return finish(start(*words, cwd=cwd, env=env), timeout)


@contextmanager
def serving(
    *words: str, cwd: Path = REPOSITORY, env: Mapping[str, str] | None = None
) -> Iterator[int]:
    """The port of a server that runs in a process of its own until the block ends."""
    with start(*words, "port=0", cwd=cwd, env=env) as server:
        try:
            lines = ""
            while not (ready := re.search(r"ready at \S*127\.0\.0\.1:(\d+)", lines)):
                line = server.stderr.readline()
                assert line, lines
                lines += line
            yield int(ready[1])
        finally:
            server.kill()
