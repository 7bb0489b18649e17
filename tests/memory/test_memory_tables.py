"""What the pages say of memory is what the code that they name counts today."""

import importlib.util
import json
import re
from types import ModuleType

import pytest
from conftest import REPOSITORY
from noop_gpu import NoopGpu, needs_noop_gpu, noop_gpu  # noqa: F401  (a fixture)

from mme_vla.testing.small import MODELS

DOCS, BENCHMARKS = REPOSITORY / "docs", REPOSITORY / "benchmarks"
EVIDENCE = DOCS / "evidence"
ROUNDING = 0.011
"""Pages give two decimals, or one."""


def table(page: str, heading: str) -> dict[str, list[str]]:
    """The first table under a heading: cells by the first of each row."""
    text = (EVIDENCE / page).read_text().split(f"\n## {heading}\n", 1)[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return {row[0]: row[1:] for row in rows[2:]}


@pytest.fixture(scope="module")
def sizes() -> ModuleType:
    spec = importlib.util.spec_from_file_location("sizes", BENCHMARKS / "sizes.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("model", ["pi05", "tokendrop_expert", "framesamp_modul", "ttt_context", "rmt_expert"])
def test_sizes_are_those_of_the_page(sizes: ModuleType, model: str) -> None:
    written = (EVIDENCE / "cost.md").read_text()
    assert sizes.of_model(model) in written.splitlines()


def test_the_page_has_every_model() -> None:
    assert {f"`{model}`" for model in MODELS} <= table("cost.md", "Size and memory").keys()


@pytest.fixture(scope="module")
def counted(noop_gpu: NoopGpu) -> dict[str, dict[str, float]]:  # noqa: F811
    """What is counted for each of these words: one process a figure."""
    jobs = ["chunk pi05", "chunk tokendrop_expert", "shared pi05:8:8"]
    lines = noop_gpu.run_each(BENCHMARKS / "gpu_memory.py", *(f"--no-cudnn {job}" for job in jobs))
    return dict(zip(jobs, map(json.loads, lines), strict=True))


@needs_noop_gpu
@pytest.mark.parametrize("model", ["pi05", "tokendrop_expert"])
def test_a_chunk_takes_what_the_page_says(counted: dict[str, dict[str, float]], model: str) -> None:
    found = counted[f"chunk {model}"]
    *_, cell, _ = table("hardware.md", "A chunk")[f"`{model}`"]
    peak, reserved = (float(number) for number in re.findall(r"\d+\.\d+", cell))
    assert found["peak"] == pytest.approx(peak, abs=ROUNDING)
    assert found["reserved"] == pytest.approx(reserved, abs=ROUNDING)
    assert found["peak"] <= 6.61


@needs_noop_gpu
def test_a_shared_update_takes_what_the_page_says(counted: dict[str, dict[str, float]]) -> None:
    found = counted["shared pi05:8:8"]
    text = (DOCS / "sharding.md").read_text()
    (peak,) = re.findall(r"^\| `pi05` \| 8 \| 8 \| *\| (\S+) \|$", text, re.MULTILINE)
    assert found["peak"] == pytest.approx(float(peak), abs=0.06)
    assert found["peak"] <= 26
