"""Where compiled code is kept, and what happens where nothing can be compiled."""

import logging
import shutil
import stat
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torch._dynamo.utils import counters
from torch._inductor.runtime.cache_dir_utils import default_cache_dir
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.nn.functional import scaled_dot_product_attention

from mme_vla.cli import loading
from mme_vla.cli.loading import prepare_sampling
from mme_vla.policy.mme import MMEPolicy
from mme_vla.speed import compile_parts
from mme_vla.speed.compiler import CACHE_VARIABLE, keep_compiled_code, missing_compiler
from mme_vla.testing.small import small_policy

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.fixture(autouse=True)
def cache_of_nobody(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No folder is named, and the user's cache folder is a new one."""
    # Set first, so that what is set by the code under test is taken back too.
    monkeypatch.setenv(CACHE_VARIABLE, "")
    monkeypatch.delenv(CACHE_VARIABLE)
    monkeypatch.setenv("MME_VLA_CACHE", str(tmp_path / "cache"))


def test_compiled_code_is_in_a_folder_that_only_its_user_can_open(tmp_path: Path) -> None:
    folder = keep_compiled_code()
    assert folder == tmp_path / "cache" / "compiled"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert keep_compiled_code() == folder


def test_a_folder_that_the_user_names_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "elsewhere"))
    assert keep_compiled_code() == tmp_path / "elsewhere"
    assert not (tmp_path / "cache").exists()


def test_a_folder_that_pytorch_chose_itself_is_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(CACHE_VARIABLE, default_cache_dir())  # as importing its compiler does
    assert keep_compiled_code() == tmp_path / "cache" / "compiled"


def attend_with_math(x: Tensor) -> Tensor:
    with sdpa_kernel([SDPBackend.MATH]):
        return scaled_dot_product_attention(x, x, x)


def test_the_traced_graph_of_an_attention_is_cached() -> None:
    keep_compiled_code()
    x = torch.ones(1, 1, 4, 8)
    for _ in range(2):
        torch.compiler.reset()
        counters.clear()
        with torch.no_grad():
            torch.compile(attend_with_math, fullgraph=True)(x)
    torch.compiler.reset()
    assert counters["aot_autograd"]["autograd_cache_hit"] == 1
    assert counters["aot_autograd"]["autograd_cache_bypass"] == 0


def test_a_missing_compiler_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert missing_compiler(CPU) is None
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert "C++ compiler" in str(missing_compiler(CPU))
    assert "C compiler (cc, gcc, clang)" in str(missing_compiler(GPU)) or "triton" in str(
        missing_compiler(GPU)
    )
    monkeypatch.setenv("CC", "mycc")
    assert missing_compiler(GPU) in ("a C compiler (mycc)", "the package triton")


@pytest.mark.parametrize("missing", [None, "the C++ compiler g++"])
def test_layers_stay_eager_with_a_warning_where_no_compiler_is(
    missing: str | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[bool] = []

    def compile_sampling(policy: MMEPolicy, layers: bool, report: object) -> bool:
        asked.append(layers)
        return True

    monkeypatch.setattr(loading, "missing_compiler", lambda device: missing)
    monkeypatch.setattr(MMEPolicy, "compile_sampling", compile_sampling)
    with caplog.at_level(logging.INFO):
        prepare_sampling(small_policy("pi05").eval(), "compiled", logging.getLogger("test"))
    assert asked == [missing is None]
    warned = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert len(warned) == (missing is not None)
    assert all("g++" in text and "sampling=auto" in text for text in warned)


def test_only_parts_with_code_to_compile_are_compiled() -> None:
    compiled: list[object] = []

    class Part(nn.Module):
        def compile(self, **options: object) -> None:
            compiled.append((self, options))

    inner = Part()
    memory = nn.Sequential(nn.Linear(1, 1), nn.Sequential(inner))
    compile_parts(memory, dynamic=False)
    compile_parts(None)
    assert compiled == [(inner, {"dynamic": False})]
    assert memory._compiled_call_impl is None
    assert memory[0]._compiled_call_impl is None
