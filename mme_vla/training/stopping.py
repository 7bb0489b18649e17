"""Leaving a run early: Ctrl-C or a cluster's SIGTERM, answered by every process after the same
update.
"""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import distributed

from mme_vla.utils.processes import end_with_parent

ANSWERED = (signal.SIGINT, signal.SIGTERM)


@dataclass
class StopRequest:
    """Call it to know whether any process was asked to stop.

    It is a collective: all processes call it after the same update, so all get the same answer,
    though the signals reach them at different moments or only one of them.

    group: the processes; None for one alone.
    """

    group: Any = None
    signal: int | None = None
    """Which signal this process was asked by; None if it was not."""

    def __call__(self) -> bool:
        requested = self.signal is not None
        if self.group is None:
            return requested
        flag = torch.tensor(int(requested))
        distributed.all_reduce(flag, distributed.ReduceOp.MAX, self.group)
        return bool(flag)


@contextmanager
def stop_requests() -> Iterator[StopRequest]:
    """While this is open, Ctrl-C and SIGTERM only ask; a second one ends the process as usual.

    Only a main thread may answer signals: in any other they do what they always do.
    """
    request = StopRequest()
    before: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {number: signal.getsignal(number) for number in ANSWERED}

    def ask(number: int, frame: Any) -> None:
        request.signal = number
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, ask)
    try:
        is_started = distributed.is_available() and distributed.is_initialized()
        if is_started and distributed.get_world_size() > 1:
            # On the CPU, and apart from the gradients' group: nothing waits for a GPU to answer.
            request.group = distributed.new_group(backend="gloo")
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if request.group is not None:
            distributed.destroy_process_group(request.group)


def leave_signals_alone(worker: int) -> None:
    """Signals go to every process of a group, data workers included: the training process alone
    handles them.

    A data worker ends with it, also when it is killed.
    """
    for number in ANSWERED:
        signal.signal(number, signal.SIG_IGN)
    end_with_parent()
