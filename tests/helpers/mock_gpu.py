"""A GPU that does nothing, where it is at hand: PyTorch's CUDA build runs on it, and what it asks for is counted."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from helpers import REPOSITORY

SOURCE = REPOSITORY.parent / "shared" / "noop_gpu" / "stub.c"
SITE = Path(torch.__file__).parents[1]
HEADERS = [SITE / "nvidia" / "cu13" / "include", SITE / "triton" / "backends" / "nvidia" / "include"]


def _lacking() -> str:
    """Why there is none; empty where there is one."""
    if not SOURCE.exists():
        return f"no GPU that does nothing: {SOURCE} is absent"
    if shutil.which("gcc") is None:
        return "no gcc to build the GPU that does nothing"
    if torch.version.cuda is None or torch.cuda.is_available():
        return "not PyTorch's CUDA build alone"
    return "" if all(folder.is_dir() for folder in HEADERS) else "this PyTorch brings no CUDA 13 headers"


_EACH = """
import gc, importlib, os, runpy, sys
script, *jobs = sys.argv[1:]
runpy.run_path(script)
for name in ("timm", "torch._dynamo"):
    importlib.import_module(name)
gc.collect()
gc.freeze()  # a child need not look through what was imported, nor copy its pages
for job in jobs:
    if (child := os.fork()) == 0:
        sys.argv = [script, *job.split()]
        runpy.run_path(script, run_name="__main__")
    if os.waitpid(child, 0)[1]:
        sys.exit(1)
"""
needs_noop_gpu = pytest.mark.skipif(bool(_lacking()), reason=_lacking() or "it is at hand")


class NoopGpu:
    """The library in the driver's place, built into `folder`."""

    def __init__(self, folder: Path) -> None:
        library, included = folder / "libcuda.so.1", [f"-I{headers}" for headers in HEADERS]
        build = ["gcc", "-shared", "-fPIC", "-O1", "-w", *included, "-o", str(library), str(SOURCE), "-ldl"]
        subprocess.run(build, check=True)
        faked = {"LD_PRELOAD": str(library), "LD_LIBRARY_PATH": str(folder), "OMP_NUM_THREADS": "1"}
        self._environment = {**os.environ, **faked}

    def run(self, *words: str) -> str:
        """What Python prints there."""
        told = subprocess.run(
            [sys.executable, *words], env=self._environment, cwd=REPOSITORY, capture_output=True, text=True
        )
        assert told.returncode == 0, told.stderr[-2000:]
        return told.stdout

    def run_each(self, script: Path, *jobs: str) -> list[str]:
        """The line of JSON that a script prints for each of these words; what it imports is imported once."""
        printed = self.run("-c", _EACH, str(script), *jobs).splitlines()
        return [line for line in printed if line.startswith("{")]


@pytest.fixture(scope="module")
def noop_gpu(tmp_path_factory: pytest.TempPathFactory) -> NoopGpu:
    return NoopGpu(tmp_path_factory.mktemp("noop_gpu"))
