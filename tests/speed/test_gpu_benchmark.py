"""The benchmark of a GPU runs anywhere at tiny size; only a GPU is judged, and what is missed ends it with 1."""

import importlib.util
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from helpers import REPOSITORY

SMALL = ["--backbone", "tiny", "--device", "cpu", "--rounds", "1", "--batch", "2", "--eager"]


@pytest.fixture(scope="module")
def gpu() -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(REPOSITORY / "benchmarks"))
        spec = importlib.util.spec_from_file_location("gpu_benchmark", REPOSITORY / "benchmarks" / "gpu.py")
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        patch.setitem(sys.modules, "gpu_benchmark", module)
        spec.loader.exec_module(module)
        yield module


def test_it_runs_on_a_cpu_and_says_what_it_could_not_measure(
    gpu: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "gpu.json"
    report.write_text('{"processes": {"8": {}}}')
    words = [*SMALL, "--workers", "0", "--no-lerobot", "--models", "framesamp_modul", "--output", str(report)]
    assert gpu.main(words) == 0
    result = json.loads(report.read_text())
    assert result["lerobot"] == "not measured" and "8" in result["processes"], "what another run found is kept"
    timings = result["models"]["framesamp_modul"]
    assert 0 < timings["feeding"]["waiting"] < 1 and timings["feeding"]["samples_per_s"] > 0
    assert timings["training"]["mfu"] is None and timings["training"]["tflop_per_sample"] > 0
    assert timings["chunk"].keys() == {"eager"} and timings["chunk"]["eager"]["p50_ms"] > 0
    printed = capsys.readouterr().out
    assert "MFU not measured" in printed and "NaN sweep: none" in printed


def test_what_misses_a_goal_is_reported(gpu: Any) -> None:
    ways = {"eager": {"p50_ms": 90.0}, "graph": {"p50_ms": 14.0}}
    row = {"training": {"finite": True, "mfu": 0.51}, "chunk": ways}
    good: dict[str, Any] = {"device": "cuda", "nan": [], "models": {"pi05": row}}
    assert gpu.judge(good) == []
    bad = {"training": {"finite": False, "mfu": 0.4}, "chunk": {"eager": {"p50_ms": 16.0}}}
    message = " ".join(gpu.judge({**good, "nan": ["sdpa at 576 keys"], "models": {"pi05": bad}}))
    assert all(word in message for word in ("576", "no number", "MFU 40%", "16.0 ms"))
