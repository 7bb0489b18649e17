"""Fixtures that find the data beside the repository, and skip clearly where it is absent."""

import logging
import os
import sys
from collections.abc import Iterator
from pathlib import Path

# Tests run in parallel (`pytest -n auto`): one thread each, as many tests as there are cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import pytest

from helpers import REPOSITORY


def _folder(variable: str, default: Path, what: str) -> Path:
    folder = Path(os.environ.get(variable, default))
    if not folder.is_dir():
        pytest.skip(
            f"{what} not found at {folder}; set {variable} to a folder of that layout to run this"
            " test"
        )
    return folder


@pytest.fixture(autouse=True)
def _isolated_plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Forget the plugins that a test imports and the parts that it registers when it ends.

    What the library's own modules register meanwhile stays: they are imported only once.
    """
    from mme_vla.config import plugins
    from mme_vla.registry import REGISTRIES

    monkeypatch.setattr(plugins, "_imported", dict(plugins._imported))
    before = {kind: set(registry._entries) for kind, registry in REGISTRIES.items()}
    yield
    for kind, registry in REGISTRIES.items():
        for name in registry._entries.keys() - before[kind]:
            if registry._entries[name].__module__.rpartition(".")[2].startswith("test_"):
                del registry._entries[name]


@pytest.fixture(autouse=True)
def _loggers_as_before() -> Iterator[None]:
    """Put the library's loggers and the root logger back when a test ends, and point log handlers
    away from the captured streams that it closes: a later test would print "Logging error" where
    they write.

    Hydra, `log_to_terminal` and packages that a test is the first to import leave such handlers.
    `log_to_terminal` also keeps a logger's records from `caplog`.
    """
    root = logging.root
    level = root.level
    yield
    root.setLevel(level)
    for name, logger in [("", root), *root.manager.loggerDict.items()]:
        if not isinstance(logger, logging.Logger):
            continue
        if name.startswith("mme_vla"):
            logger.handlers, logger.propagate = [], True
            logger.setLevel(logging.NOTSET)
        for handler in logger.handlers:
            if type(handler) is logging.StreamHandler and handler.stream.closed:
                handler.stream = sys.stderr  # `setStream` would flush the closed one


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """With `MME_VLA_PARITY_TABLE=1`, print the largest error of every parity test as the table of
    docs/evidence.
    """
    if os.environ.get("MME_VLA_PARITY_TABLE"):
        from helpers import golden

        terminalreporter.write_line("| test | largest absolute error |\n|---|---|")
        for test, worst in sorted(golden.ERRORS.items()):
            terminalreporter.write_line(f"| `{test}` | {worst:.1e} |")


@pytest.fixture(scope="session")
def renderer() -> str:
    """The device that renders; skips where there is none."""
    pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")
    from mme_vla.envs.rendering import render_backend
    from mme_vla.errors import UserError

    try:
        return render_backend()
    except UserError as error:
        pytest.skip(f"cannot render here: {error}")


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with specifications and reference data that developers have beside
    the repository.
    """
    return _folder("MME_VLA_SHARED", REPOSITORY.parent / "shared", "reference data")


@pytest.fixture(scope="session")
def parity() -> Path:
    """Golden inputs, parameters and outputs of the released implementation."""
    return _folder("MME_VLA_PARITY", REPOSITORY.parent / "shared" / "parity", "golden parity data")


@pytest.fixture(scope="session")
def h5_folder() -> Path:
    """Official demonstration files, record_dataset_<Task>.h5."""
    return _folder(
        "MME_VLA_ROBOMME_H5", REPOSITORY.parent / "shared" / "robomme_h5", "RoboMME HDF5 episodes"
    )
