"""A compiled chunk has few kernels, whose number is most of its time on a GPU, and is the eager
one.
"""

import json
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch._dynamo.utils import counters
from torch._inductor import metrics

from helpers.tiers import slow_or_nightly
from mme_vla.testing.small import random_batch, small_policy

REPOSITORY = Path(__file__).parents[2]
MOCK_DRIVER = REPOSITORY.parent / "shared" / "noop_gpu"


@pytest.fixture
def nothing_compiled(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """No compiled code before or after, nor kernels and graphs counted."""
    monkeypatch.setattr(logging.getLogger("torch.__trace"), "disabled", True)
    torch.compiler.reset()
    counters.clear()
    metrics.reset()
    yield
    torch.compiler.reset()


@pytest.mark.usefixtures("nothing_compiled")
@pytest.mark.parametrize(
    ("model", "graphs", "kernels"),
    slow_or_nightly([("pi05", 7, 57), ("framesamp_modul", 8, 71)], lambda case: case[0] == "pi05"),
)
def test_a_compiled_chunk_has_few_kernels_and_graphs_at_any_depth(
    model: str, graphs: int, kernels: int
) -> None:
    depths = {"backbone.depth": 4, "backbone.vision.depth": 1}
    policy = small_policy(model, **depths).eval()
    batch = random_batch(policy, 1)
    noise = torch.randn(1, 20, 32, generator=torch.Generator().manual_seed(0))
    eager = policy.sample_actions(batch, noise, steps=3)
    policy.processor = None  # no length of prompt is compiled beforehand
    policy.compile_sampling(layers=True)
    with torch._inductor.config.patch(force_disable_caches=True):
        compiled = policy.sample_actions(batch, noise, steps=3)
    torch.testing.assert_close(compiled, eager, atol=1e-5, rtol=0)
    # The tower, a layer and the last layer of the prefix, a layer of a step, what is around its
    # layers, and the keys and values of a modulator: first and last layers share their code.
    assert counters["stats"]["unique_graphs"] == graphs
    assert metrics.generated_kernel_count <= kernels


@pytest.fixture(scope="module")
def mock_driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A CUDA driver that counts and computes nothing, built from its `stub.c`.

    `MME_VLA_MOCK_DRIVER` names its folder, `../shared/noop_gpu` by default.
    """
    source = Path(os.environ.get("MME_VLA_MOCK_DRIVER", MOCK_DRIVER)) / "stub.c"
    if not source.exists() or torch.version.cuda is None or shutil.which("gcc") is None:
        pytest.skip("the mock driver, gcc or a CUDA build of torch is missing")
    packages = Path(torch.__file__).parents[1]
    library = tmp_path_factory.mktemp("driver") / "libcuda.so.1"
    includes = ("nvidia/cu13/include", "triton/backends/nvidia/include")
    command = ["gcc", "-shared", "-fPIC", "-w", *(f"-I{packages / path}" for path in includes)]
    subprocess.run([*command, "-o", library, source, "-ldl"], check=True)
    return library


def run_on(driver: Path, program: str, *words: str) -> str:
    """What a script of `benchmarks` prints on the mock driver."""
    environment = os.environ | {
        "LD_PRELOAD": str(driver),
        "LD_LIBRARY_PATH": str(driver.parent),
        "PYTHONPATH": str(REPOSITORY),
    }
    command = [sys.executable, str(REPOSITORY / "benchmarks" / program), *words]
    done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout


def check_counts(printed: str, launches: int, products: int) -> None:
    counted = json.loads(printed.splitlines()[-1])
    assert counted["launches"] <= launches
    assert counted["products"] == products
    assert counted["waits"] == 0


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("model", "way", "launches", "products"),
    [
        ("pi05", "compiled", 1310, 921),
        ("framesamp_modul", "compiled", 1920, 1479),
        ("tokendrop_expert", "compiled", 1320, 990),
        ("ttt_expert", "compiled", 1320, 990),
        ("rmt_context", "compiled", 1320, 921),
        ("pi05", "eager", 3680, 921),
        ("framesamp_modul", "eager", 5830, 1479),
    ],
)
def test_a_full_size_chunk_launches_few_kernels(
    model: str, way: str, launches: int, products: int, mock_driver: Path
) -> None:
    check_counts(run_on(mock_driver, "gpu_kernels.py", model, "--ways", way), launches, products)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("model", "way", "launches", "products"),
    [
        ("pi05", "compiled", 2070, 655),
        ("framesamp_modul", "compiled", 2770, 876),
        ("pi05", "eager", 3680, 655),
        ("framesamp_modul", "eager", 5060, 876),
        ("rmt_context", "eager", 9860, 1719),
        ("ttt_expert", "eager", 15260, 1517),
    ],
)
def test_a_full_size_update_launches_few_kernels(
    model: str, way: str, launches: int, products: int, mock_driver: Path
) -> None:
    words = ("gpu_kernels.py", model, "--what", "update", "--ways", way, "--batch", "1")
    check_counts(run_on(mock_driver, *words), launches, products)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("model", "parts"),
    [
        ("pi05", ("attention", "chunk", "training")),
        ("framesamp_modul", ("chunk", "training")),
        ("ttt_expert", ("chunk",)),
        ("pi05", ("lerobot", "openpi")),
        ("tokendrop_expert", ("profile", "tuned", "feeding")),
    ],
)
def test_no_row_of_the_measurement_of_a_gpu_fails_where_that_shows_without_one(
    model: str, parts: tuple[str, ...], mock_driver: Path, tmp_path: Path
) -> None:
    output = tmp_path / "gpu.json"
    sizes = ("--backbone", "tiny", "--rounds", "1", "--batch", "1", "--workers", "1")
    words = ("--rehearse", *sizes, "--models", model, "--output", str(output))
    printed = run_on(mock_driver, "gpu.py", *words, "--parts", *parts)
    assert "FAILED" not in printed
    measured = json.loads(output.read_text())
    rows = {**measured, **measured["models"].get(model, {})}
    assert set(parts) - {"lerobot"} <= set(rows)
    if "profile" in parts:
        assert "the profiler saw no kernel" in rows["profile"]
