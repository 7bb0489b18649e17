"""What the pages say of memory is what the code that they name counts today."""

import importlib.util
from types import ModuleType

import pytest

from helpers import REPOSITORY
from mme_vla.testing.small import MODELS

DOCS, BENCHMARKS = REPOSITORY / "docs", REPOSITORY / "benchmarks"
EVIDENCE = DOCS / "evidence"


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
    page = (EVIDENCE / "cost.md").read_text()
    assert sizes.of_model(model) in page.splitlines()


def test_the_page_has_every_model() -> None:
    assert {f"`{model}`" for model in MODELS} <= table("cost.md", "Size and memory").keys()
