"""The benchmark of a GPU runs anywhere at tiny size; only a GPU is judged, and what is missed ends it with 1."""

import importlib.util
import json
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from helpers import REPOSITORY, commands

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
    whole = json.loads(report.read_text())
    assert whole["lerobot"] == "not measured" and "8" in whole["processes"], "what another run found is kept"
    found = whole["models"]["framesamp_modul"]
    assert 0 < found["feeding"]["waiting"] < 1 and found["feeding"]["samples_per_s"] > 0
    assert found["training"]["mfu"] is None and found["training"]["tflop_per_sample"] > 0
    assert found["chunk"].keys() == {"eager"} and found["chunk"]["eager"]["p50_ms"] > 0
    printed = capsys.readouterr().out
    assert "MFU not measured" in printed and "NaN sweep: none" in printed


def test_recurrent_memories_compute_more_than_their_model_needs(gpu: Any) -> None:
    sample_flops = sys.modules["gpu_setup"].sample_flops
    needed, computed = sample_flops("rmt_context", "tiny")
    assert 0 < needed < computed
    assert len(set(sample_flops("pi05", "tiny"))) == 1


def test_what_misses_a_goal_is_told(gpu: Any) -> None:
    ways = {"eager": {"p50_ms": 90.0}, "graph": {"p50_ms": 14.0}}
    row = {"training": {"finite": True, "mfu": 0.51}, "chunk": ways}
    good: dict[str, Any] = {"device": "cuda", "nan": [], "models": {"pi05": row}}
    assert gpu.judge(good) == []
    bad = {"training": {"finite": False, "mfu": 0.4}, "chunk": {"eager": {"p50_ms": 16.0}}}
    told = " ".join(gpu.judge({**good, "nan": ["sdpa at 576 keys"], "models": {"pi05": bad}}))
    assert all(word in told for word in ("576", "no number", "MFU 40%", "16.0 ms"))


def test_lerobots_own_network_stands_beside_ours(gpu: Any) -> None:
    pytest.importorskip("lerobot.policies.pi05.modeling_pi05", reason="LeRobot's PI05 is not installed")
    from gpu_lerobot import lerobot_row
    from gpu_setup import Setup

    row = lerobot_row(Setup("tiny", 1, 1, gpu.torch.device("cpu"), False, "auto"))
    assert row["training"]["samples_per_s"] > 0 and row["chunk"]["eager"]["p50_ms"] > 0


@pytest.mark.slow
def test_many_processes_add_a_line_for_each_way_to_share(tmp_path: Path) -> None:
    report = tmp_path / "gpu.json"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["benchmarks/gpu.py", *SMALL, "--models", "tokendrop_expert", "--output", str(report)]
    rendezvous = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    started = [commands.start(*words, env={**rendezvous, "RANK": str(r), "LOCAL_RANK": str(r)}) for r in range(2)]
    first, second = (commands.finish(process, 120) for process in started)
    assert (first.returncode, second.returncode) == (0, 0), first.stderr + second.stderr
    found = json.loads(report.read_text())["processes"]["2"]
    assert found.keys() == {"tokendrop_expert, ddp", "tokendrop_expert, fsdp"}
    assert all(row["finite"] and row["samples_per_s"] > 0 for row in found.values())
    assert first.stdout.count("2 processes: update") == 2 and not second.stdout
