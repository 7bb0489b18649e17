"""Runs commands one after the other, each in a fork of one process that has imported PyTorch and LeRobot once.

Standard input: a JSON list of commands, each `[words, hidden modules, wait]`. `wait` is a text: once it was printed,
the command gets SIGTERM. Standard output: a JSON list of what became of each, `[exit code, what it printed]`.
"""

import importlib
import io
import json
import os
import runpy
import signal
import socket
import sys
import tempfile
import time
import traceback
from contextlib import redirect_stderr
from multiprocessing import connection, forkserver, resource_tracker
from pathlib import Path
from typing import Any

import sitecustomize

from mme_vla.envs.vector import processes

SLOW = (
    "torch", "lerobot.datasets.lerobot_dataset", "matplotlib.pyplot", "timm", "mme_vla.policy.mme",
    "mme_vla.training.loop",
)  # fmt: skip
"""What most commands import, without any extra."""


COMMANDS = (
    "mme_vla.cli.evaluate", "mme_vla.cli.gallery", "mme_vla.cli.play",
    "mme_vla.cli.record", "mme_vla.cli.serve", "mme_vla.cli.train", "mme_vla.cli.weights",
)  # fmt: skip
"""Hydra, and what needs it: as it is imported it looks for its plugins, one of which is an extra's."""


SIMULATOR, PLUGIN = "mani_skill", "hydra_plugins.hydra_joblib_launcher"


def hide(modules: list[str]) -> None:
    """Let these modules not exist, here and in processes started from here."""
    sitecustomize.Selective.hidden = frozenset(modules)
    os.environ["HIDDEN_MODULES"] = " ".join(modules)


def have_simulator(hidden: list[str]) -> None:
    """Import it, where all but its own extra is hidden, and be forked: simulating processes are, in turn, from that."""
    hide(hidden)
    for module in processes.PRELOADED:
        importlib.import_module(module)
    resource_tracker.ensure_running()
    server: Any = forkserver._forkserver
    alive, server._forkserver_alive_fd = os.pipe()
    with socket.socket(socket.AF_UNIX) as listener:
        server._forkserver_address = connection.arbitrary_address("AF_UNIX")
        listener.bind(server._forkserver_address)
        listener.listen()
        if os.fork() == 0:
            os.close(server._forkserver_alive_fd)  # it ends with the last process that holds the other end
            forkserver.main(listener.detach(), alive, [])
    os.close(alive)


def child(words: list[str], hidden: list[str], printed: int) -> None:
    """Be the command; never returns."""
    code: object = 0
    try:
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        hide(hidden)
        if SIMULATOR not in hidden:
            forkserver._forkserver.ensure_running = lambda: None  # type: ignore[method-assign]
        sys.argv = list(words)
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
    except SystemExit as error:
        code = error.code or 0
    except BaseException:
        traceback.print_exc()
        code = 99
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code if isinstance(code, int) else 1)


def run(words: list[str], hidden: list[str], wait: str) -> tuple[int, str]:
    """Fork, and collect what the command printed."""
    with tempfile.TemporaryFile() as printed:
        pid = os.fork()
        if pid == 0:
            child(words, hidden, printed.fileno())
        end, stopped, status = time.monotonic() + 200, not wait, None
        while status is None:
            done, found = os.waitpid(pid, os.WNOHANG)
            if done:
                status = os.waitstatus_to_exitcode(found)
            elif time.monotonic() > end:
                os.kill(pid, signal.SIGKILL)
            elif not stopped and wait.encode() in os.pread(printed.fileno(), 2**20, 0):
                os.kill(pid, signal.SIGTERM)
                stopped = True
            time.sleep(0.02)
        return status, os.pread(printed.fileno(), 2**20, 0).decode(errors="replace")


if __name__ == "__main__":
    asked = json.load(sys.stdin)
    with redirect_stderr(io.StringIO()):
        for slow in SLOW:
            importlib.import_module(slow)
    ended: dict[int, tuple[int, str]] = {}
    installed = {SIMULATOR, PLUGIN} & sitecustomize.Selective.hidden
    there = [installed - set(hidden) for _, hidden, _ in asked]
    for needed in ({PLUGIN}, set(), {SIMULATOR}):
        some = [i for i in range(len(asked)) if there[i] == needed]
        if not needed:
            sys.path.append(str(Path(__file__).parents[1]))
            for slow in COMMANDS:
                importlib.import_module(slow)
            sys.path.pop()
        elif needed == {SIMULATOR} and some:
            have_simulator(max((asked[i][1] for i in some), key=len))
        ended |= {i: run(*asked[i]) for i in some}
    print(json.dumps([ended[i] for i in range(len(asked))]))
