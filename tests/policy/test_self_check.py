"""The self-check of a checkpoint: it passes, names a difference, and is read as untrusted."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from helpers.trainings import STATS, policy
from mme_vla import MMEPolicy, UserError
from mme_vla.policy.card import CARD_FILE
from mme_vla.policy.saving import save_policy
from mme_vla.policy.self_check import (
    BFLOAT16_TOLERANCE,
    FILE,
    MOST_BYTES,
    compare,
    read_self_check,
    record_self_check,
)
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.utils import SUMS, write_sums


@pytest.fixture(scope="module", params=["pi05", "framesamp_modul"])
def intact(request: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("checked")
    built = policy(request.param)
    save_policy(built, folder, self_check=record_self_check(built))
    return folder


@pytest.fixture
def checkpoint(intact: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(intact, tmp_path / "checkpoint"))


def without_sums(folder: Path) -> Path:
    (folder / SUMS).unlink()
    return folder


def rewrite(folder: Path, **changes: torch.Tensor | None) -> None:
    """Change tensors of the file as an attacker may who writes the sums too."""
    with safe_open(folder / FILE, "pt") as opened:
        about = opened.metadata()
    tensors = {**load_file(folder / FILE), **changes}
    save_file({k: v for k, v in tensors.items() if v is not None}, folder / FILE, about)
    write_sums(folder, [FILE], keep=True)


def test_a_checkpoint_passes_its_check(intact: Path) -> None:
    result = compare(MMEPolicy.from_pretrained(intact), intact)
    assert result is not None and result.passed and result.chunk < 1e-6
    assert result.line.startswith("self-check: passed")
    assert FILE in (intact / SUMS).read_text()
    assert FILE in (intact / CARD_FILE).read_text()
    assert (intact / FILE).stat().st_size <= MOST_BYTES


def test_bfloat16_is_within_its_tolerance(intact: Path) -> None:
    result = compare(MMEPolicy.from_pretrained(intact, dtype="bfloat16"), intact)
    assert result is not None and result.passed and result.chunk > 0
    assert "bfloat16" in result.current and result.tolerance == BFLOAT16_TOLERANCE


def test_a_policy_that_computes_in_bfloat16_is_compared_in_float32(intact: Path) -> None:
    loaded = MMEPolicy.from_pretrained(intact, compute_dtype="bfloat16")
    result = compare(loaded, intact)
    assert result is not None and result.passed and result.chunk < 1e-6
    assert loaded.compute_dtype == torch.bfloat16


@pytest.mark.parametrize("share", [0.01, 0.1])
def test_changed_weights_fail_with_a_sentence(intact: Path, share: float) -> None:
    loaded = MMEPolicy.from_pretrained(intact)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in loaded.parameters():
            parameter.mul_(1 + share * torch.randn(parameter.shape, generator=generator))
    result = compare(loaded, intact)
    assert result is not None and not result.passed and result.actions == 0
    assert "FAILED" in result.line and "fetch the checkpoint again" in result.line


def test_weights_of_another_seed_fail_in_bfloat16_too(intact: Path, tmp_path: Path) -> None:
    name = MMEPolicy.from_pretrained(intact).config["name"]
    policy(name, seed=5).save_pretrained(tmp_path)
    for dtype in ("float32", "bfloat16"):
        result = compare(MMEPolicy.from_pretrained(tmp_path, dtype=dtype), intact)
        assert result is not None and not result.passed


def test_other_statistics_of_the_actions_fail_as_statistics(intact: Path) -> None:
    loaded = MMEPolicy.from_pretrained(intact)
    wider = QuantileStats(STATS.mean, STATS.std, 1.01 * STATS.q01, STATS.q99)
    loaded.require_processor().stats = NormStats(STATS, wider)
    result = compare(loaded, intact)
    assert result is not None and not result.passed and result.chunk < 1e-6
    assert "The statistics, the robot or the code" in result.line


def test_a_loaded_policy_that_is_saved_again_has_a_check_of_its_weights(
    intact: Path, tmp_path: Path
) -> None:
    loaded = MMEPolicy.from_pretrained(intact)
    loaded.save_pretrained(tmp_path / "same")
    assert (tmp_path / "same" / FILE).read_bytes() == (intact / FILE).read_bytes()
    loaded.save_pretrained(tmp_path / "rounded", dtype="bfloat16")
    with torch.no_grad():
        for parameter in loaded.parameters():
            parameter.mul_(1.1)
    loaded.save_pretrained(tmp_path / "changed")
    assert (tmp_path / "changed" / FILE).read_bytes() != (intact / FILE).read_bytes()
    for name in ("same", "rounded", "changed"):
        result = compare(MMEPolicy.from_pretrained(tmp_path / name), tmp_path / name)
        assert result is not None and result.passed, name


def test_a_policy_that_cannot_be_checked_is_saved_without(
    intact: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded = MMEPolicy.from_pretrained(intact)

    def fail(*arguments: object) -> None:
        raise RuntimeError("cannot see")

    monkeypatch.setattr(loaded, "predict_chunk", fail)
    with pytest.warns(UserWarning, match="without a self-check: RuntimeError: cannot see"):
        loaded.save_pretrained(tmp_path)
    assert MMEPolicy.from_pretrained(tmp_path) and not (tmp_path / FILE).exists()


def test_recording_is_deterministic_and_leaves_generators_alone() -> None:
    built = policy("framesamp_modul").train()
    before = torch.get_rng_state()
    assert record_self_check(built).to_bytes() == record_self_check(built).to_bytes()
    assert torch.equal(before, torch.get_rng_state())
    assert built.training


def test_an_older_checkpoint_has_none(tmp_path: Path) -> None:
    built = policy()
    save_policy(built, tmp_path, self_check=record_self_check(built))
    save_policy(built, tmp_path)  # over it: a check of other weights does not stay
    assert not (tmp_path / FILE).exists()
    assert compare(built, tmp_path) is None


def test_a_removed_or_damaged_file_is_refused(checkpoint: Path) -> None:
    content = (checkpoint / FILE).read_bytes()
    (checkpoint / FILE).write_bytes(content[:-3])
    with pytest.raises(UserError, match=FILE):
        read_self_check(checkpoint)
    (checkpoint / FILE).unlink()
    with pytest.raises(UserError, match="lacks self_check"):
        read_self_check(checkpoint)
    without_sums(checkpoint)
    (checkpoint / FILE).write_bytes(content[:-3])
    with pytest.raises(UserError, match="damaged"):
        read_self_check(checkpoint)
    (checkpoint / FILE).write_bytes(content + bytes(MOST_BYTES))
    with pytest.raises(UserError, match="more than the"):
        read_self_check(checkpoint)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"chunk": None}, "lacks"),
        ({"chunk": torch.zeros(2, 3)}, "chunk is"),
        ({"actions": torch.zeros(2, 3)}, "actions is"),
        ({"chunk": torch.zeros(2, 3, dtype=torch.bfloat16)}, "bfloat16"),
        ({"view/other": torch.zeros(1, 2, 2, 3, dtype=torch.uint8)}, "cameras"),
        ({"states": torch.zeros(900, 8)}, "900 frames"),
        ({"more": torch.zeros(2, 3)}, "is no self-check"),
        ({"chunk": torch.full((2, 3), torch.nan)}, "NaN"),
        ({"states": torch.zeros(3, 3)}, "does not fit"),
        ({"is_demo": torch.zeros(2, 2)}, "is no self-check"),
        ({"view/front": torch.zeros(4)}, "is no self-check"),
        ({"noise/other": torch.zeros(4)}, "noise"),
    ],
)
def test_a_file_that_does_not_fit_is_refused(
    checkpoint: Path, changes: dict[str, Any], reason: str
) -> None:
    rewrite(checkpoint, **changes)
    with pytest.raises(UserError, match=reason):
        compare(MMEPolicy.from_pretrained(checkpoint), checkpoint)


def test_a_file_without_a_description_is_refused(checkpoint: Path) -> None:
    for about in (None, {"about": "{"}, {"about": "[]"}, {"about": '{"format": 3}'}):
        save_file(load_file(checkpoint / FILE), checkpoint / FILE, about)
        write_sums(checkpoint, [FILE], keep=True)
        with pytest.raises(UserError):
            read_self_check(checkpoint)
