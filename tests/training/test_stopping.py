"""Being asked to stop, by one process or many; and what is computed only for updates that are
logged.
"""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from helpers import commands
from helpers.trainings import loggers, policy, trainer
from mme_vla.policy.run_folders import resolve_checkpoint
from mme_vla.training.logging import ProgressLine, Window, read_metrics
from mme_vla.training.stopping import stop_requests

STOP_ONCE = """
import os, signal, sys
from torch import distributed
from mme_vla.training.stopping import stop_requests
meeting, rank = sys.argv[1], int(sys.argv[2])
distributed.init_process_group("gloo", init_method=f"file://{meeting}", rank=rank, world_size=2)
with stop_requests() as stop:
    for step in range(1, 7):
        if rank == 1 and step == 3:
            os.kill(os.getpid(), signal.SIGTERM)
        if stop():
            break
print("stopped after", step)
distributed.destroy_process_group()
"""


def test_a_stop_signal_saves_and_leaves(tmp_path: Path) -> None:
    class Interrupted(ProgressLine):
        def advance(self) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

    handler = signal.getsignal(signal.SIGTERM)
    built = trainer(tmp_path)
    with Interrupted(6, 0, visible=False) as line:
        assert not built.run(line, loggers(tmp_path))
    assert resolve_checkpoint(tmp_path).name == "step_000001"
    assert signal.getsignal(signal.SIGTERM) == handler


@pytest.mark.slow
def test_all_processes_stop_after_the_same_update_when_one_is_queried(tmp_path: Path) -> None:
    (tmp_path / "asked.py").write_text(STOP_ONCE)
    words = (str(tmp_path / "asked.py"), str(tmp_path / "meeting"))
    started = [commands.start(*words, str(rank)) for rank in range(2)]
    assert [commands.finish(process).stdout.strip() for process in started] == [
        "stopped after 3"
    ] * 2


@pytest.fixture
def default_interrupt() -> Iterator[None]:
    """Ctrl-C as Python has it: a process that a script starts in its background ignores it from the
    start.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("default_interrupt")
def test_a_second_signal_ends_the_process_by_the_default_handler() -> None:
    with pytest.raises(KeyboardInterrupt), stop_requests() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop()
        signal.raise_signal(signal.SIGINT)


def test_a_memory_reports_only_for_updates_that_are_logged(tmp_path: Path) -> None:
    built = trainer(tmp_path, policy("ttt_modul"), steps=5, log_every=2, save_every=3)
    reported, forward = [], built.policy.memory.forward

    def noting(history):
        tokens = forward(history)
        if built.policy.training:
            reported.append(bool(tokens.metrics))
        return tokens

    built.policy.memory.forward = noting
    with ProgressLine(5, 0, visible=False) as line:
        assert built.run(line, loggers(tmp_path))
    assert reported == [
        False,
        True,
        True,
        True,
        True,
    ]  # 2 and 4 are logged, 3 is saved, 5 is the last
    lines = [line for line in read_metrics(tmp_path) if "train/loss" in line]
    assert [line["step"] for line in lines] == [2, 3, 4, 5]
    assert all("train/memory/inner_loss_before" in line for line in lines)


def test_a_number_is_averaged_over_the_updates_that_report_it() -> None:
    window = Window(batch_size=1)
    window.add({"loss": torch.tensor(1.0)})
    window.add({"loss": torch.tensor(3.0), "memory/rate": torch.tensor(0.5)})
    values = window.close(2, lambda x, reduction: x)
    assert values["train/loss"] == 2
    assert values["train/memory/rate"] == 0.5


def test_numbers_keep_the_order_in_which_updates_report_them() -> None:
    window = Window(batch_size=1)
    window.add({"loss": torch.tensor(1.0), "lr": 0.5, "grad_norm": torch.tensor(2.0)})
    values = window.close(1, lambda x, reduction: x)
    assert [*values.items()][:3] == [("train/loss", 1), ("train/lr", 0.5), ("train/grad_norm", 2)]
