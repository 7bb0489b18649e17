"""How processes that simulate are started: quickly, and with nothing of the one that starts them but its settings."""

import multiprocessing
import os
from collections.abc import Callable, Mapping
from typing import Any

PRELOADED = ["mme_vla.envs.vector.preloaded"]
"""Modules that simulating processes have imported before they begin; settled when the first of them is started."""


def simulating_processes() -> Any:
    """The context of `multiprocessing` in which processes that simulate are started.

    They are forked from one process that has imported the simulator and done nothing else: it holds no GPU and no
    renderer. These imports take 5 s of CPU time, which every worker would spend otherwise, and every one that replaces
    a lost worker. The environment variables it passes on are as old as itself, so `begin` renews them.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    return context


def settings() -> dict[str, str]:
    """The environment variables that a process is to begin with."""
    return dict(os.environ)


def begin(variables: Mapping[str, str], work: Callable[..., Any], *arguments: Any) -> Any:
    """First in a process: take the environment variables of the one that asked for it, then do its work."""
    os.environ.clear()
    os.environ.update(variables)
    return work(*arguments)
