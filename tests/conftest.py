"""Fixtures that find the data beside the repository, and skip clearly where it is absent."""

import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

# Tests are run side by side (`pytest -n auto`): one thread each, as many tests as there are cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# glibc: processes started from here keep freed memory. Asking the system for it again is a tenth of small trainings.
os.environ.setdefault("MALLOC_MMAP_THRESHOLD_", str(2**25))
os.environ.setdefault("MALLOC_TRIM_THRESHOLD_", str(2**31 - 1))
os.environ.setdefault("MALLOC_TOP_PAD_", str(2**26))

import pytest
import shared_compositions
from forked_workers import Collected

from mme_vla.envs.vector import processes

REPOSITORY = Path(__file__).resolve().parent.parent

# Hundreds of processes import the library: told not to write what they compile, each would compile it anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# What commands import besides: `forked.py` runs them in the same way as workers.
processes.PRELOADED += [
    "lerobot.datasets.lerobot_dataset", "matplotlib.pyplot", "timm", "mme_vla.training.loop", "composed_before",
]  # fmt: skip


def _folder(variable: str, default: Path, what: str) -> Path:
    folder = Path(os.environ.get(variable, default))
    if not folder.is_dir():
        pytest.skip(f"{what} not found at {folder}; set {variable} to a folder of that layout to run this test")
    return folder


def pytest_configure(config: pytest.Config) -> None:
    """Files in their order: pytest-xdist would begin with those of many tests, and end with the longest single ones.

    Test workers have one process in common that commands and simulating processes are forked from.
    """
    config.option.loadscopereorder = False
    if shared_compositions.FOLDER not in os.environ:
        composed = os.environ[shared_compositions.FOLDER] = tempfile.mkdtemp(prefix="composed")
        config.add_cleanup(lambda: shutil.rmtree(composed, ignore_errors=True))
    if not getattr(config.option, "numprocesses", None):  # a process that runs tests, or that such are forked from
        shared_compositions.share()
    given = getattr(config, "workerinput", {}).get("forkserver")
    if given is not None:
        server: Any = forkserver._forkserver
        server._forkserver_address, server._forkserver_alive_fd = given, os.open(os.devnull, os.O_RDONLY)
        server.ensure_running = lambda: None  # the process that started the test workers did


FIRST = ("test_extras.py", "test_wheel.py", "test_kill.py")
"""Files that take longest; begun last, they would be waited for."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.name not in FIRST)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config, specs: Sequence[Any]) -> None:
    """Before the test workers start: start the process that they are forked from."""
    if sys.platform == "linux" and all(spec.popen and not spec.python for spec in specs):
        collected = Collected(config.args, config.invocation_params.dir)
        config.add_cleanup(collected.end)
        for spec in specs:
            spec.python = collected.python


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Before a test worker starts: tell it where that process listens."""
    processes.simulating_processes()
    forkserver.ensure_running()
    node.workerinput["forkserver"] = forkserver._forkserver._forkserver_address  # type: ignore[attr-defined]


_MEMORY_OF_A_WORKER = 3 * 2**30


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int | None:
    """`-n auto`: two workers for each core, as tests wait for disks, processes and each other's end."""
    if "PYTEST_XDIST_AUTO_NUM_WORKERS" in os.environ:
        return None
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(1, min(cores * 2, memory // _MEMORY_OF_A_WORKER))


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish() -> None:
    """Pytest collects garbage five times over at its end: once is enough for all that tests have left."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _own_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test imports as a plugin is asked of its own worker processes alone, not of the next test's."""
    from mme_vla.config import plugins

    monkeypatch.setattr(plugins, "_imported", dict(plugins._imported))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """With `MME_VLA_PARITY_TABLE=1`, print the largest error of every parity test as the table of docs/evidence."""
    if os.environ.get("MME_VLA_PARITY_TABLE"):
        import golden

        terminalreporter.write_line("| test | largest absolute error |\n|---|---|")
        for test, worst in sorted(golden.ERRORS.items()):
            terminalreporter.write_line(f"| `{test}` | {worst:.1e} |")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with specifications and reference data that developers have beside the repository."""
    return _folder("MME_VLA_SHARED", REPOSITORY.parent / "shared", "reference data")


@pytest.fixture(scope="session")
def parity() -> Path:
    """Golden inputs, parameters and outputs of the released implementation."""
    return _folder("MME_VLA_PARITY", REPOSITORY.parent / "shared" / "parity", "golden parity data")


@pytest.fixture(scope="session")
def h5_folder() -> Path:
    """Official demonstration files, record_dataset_<Task>.h5."""
    return _folder("MME_VLA_ROBOMME_H5", REPOSITORY.parent / "shared" / "robomme_h5", "RoboMME HDF5 episodes")
