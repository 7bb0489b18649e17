"""The self-check of a checkpoint: it passes, names a difference, and is read as untrusted."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from helpers.trainings import policy
from mme_vla import MMEPolicy, UserError
from mme_vla.policy.card import CARD_FILE
from mme_vla.policy.saving import save_policy
from mme_vla.policy.self_check import FILE, MOST_BYTES, compare, read_self_check, record_self_check
from mme_vla.policy.tensor_files import WEIGHTS
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
    """Change tensors of the file as somebody may who writes the sums too."""
    with safe_open(folder / FILE, "pt") as opened:
        about = opened.metadata()
    tensors = {**load_file(folder / FILE), **changes}
    save_file({k: v for k, v in tensors.items() if v is not None}, folder / FILE, about)
    write_sums(folder, [FILE], keep=True)


def test_a_checkpoint_passes_its_check(intact: Path) -> None:
    result = compare(MMEPolicy.from_pretrained(intact), intact)
    assert result is not None and result.passed and result.difference < 1e-4
    assert result.line.startswith("self-check: passed")
    assert FILE in (intact / SUMS).read_text()
    assert FILE in (intact / CARD_FILE).read_text()
    assert (intact / FILE).stat().st_size <= MOST_BYTES


def test_bfloat16_is_within_its_tolerance(intact: Path) -> None:
    result = compare(MMEPolicy.from_pretrained(intact, dtype="bfloat16"), intact)
    assert result is not None and result.passed and result.difference > 0
    assert "bfloat16" in result.now and result.kind == "mean"


def test_changed_weights_fail_with_a_sentence(checkpoint: Path) -> None:
    tensors = load_file(checkpoint / WEIGHTS)
    name = next(name for name in tensors if name.endswith("action_out.weight"))
    save_file({**tensors, name: tensors[name] * 1.5}, checkpoint / WEIGHTS)
    write_sums(checkpoint, [WEIGHTS], keep=True)
    result = compare(MMEPolicy.from_pretrained(checkpoint), checkpoint)
    assert result is not None and not result.passed
    assert "FAILED" in result.line and "fetch the checkpoint again" in result.line


def test_recording_is_deterministic_and_leaves_generators_alone() -> None:
    built = policy("framesamp_modul").train()
    before = torch.get_rng_state()
    assert record_self_check(built)._content() == record_self_check(built)._content()
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
