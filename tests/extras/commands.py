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
import sys
import tempfile
import time
import traceback
from contextlib import redirect_stderr

import sitecustomize

SLOW = (
    "torch", "lerobot.datasets.lerobot_dataset", "matplotlib.pyplot", "mme_vla.policy.mme",
    "mme_vla.training.loop",
)  # fmt: skip
"""What most commands import, without any extra; not Hydra, which looks for its plugins as it is imported."""


def child(words: list[str], hidden: list[str], printed: int) -> None:
    """Be the command; never returns."""
    code: object = 0
    try:
        os.dup2(printed, 1)
        os.dup2(printed, 2)
        sitecustomize.Selective.hidden = frozenset(hidden)
        os.environ["HIDDEN_MODULES"] = " ".join(hidden)
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
    print(json.dumps([run(*command) for command in asked]))
