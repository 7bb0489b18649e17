"""Training stores the self-check of its averaged weights with each checkpoint."""

from pathlib import Path

import pytest

from helpers.trainings import loggers, trainer
from mme_vla import MMEPolicy
from mme_vla.policy.run_folders import resolve_checkpoint
from mme_vla.policy.self_check import FILE, compare
from mme_vla.training.logging import ProgressLine
from mme_vla.training.loop import Trainer
from mme_vla.utils import SUMS


def train(folder: Path, **changes: object) -> Trainer:
    built = trainer(folder, steps=2, **changes)
    with ProgressLine(2, 0, visible=False) as line:
        assert built.run(line, loggers(folder))
    return built


def test_a_trained_checkpoint_passes_its_check(tmp_path: Path) -> None:
    assert train(tmp_path).unchecked is None
    checkpoint = resolve_checkpoint(tmp_path)
    result = compare(MMEPolicy.from_pretrained(checkpoint), checkpoint)
    assert result is not None and result.passed
    assert FILE in (checkpoint / SUMS).read_text()


def test_it_can_be_left_out(tmp_path: Path) -> None:
    train(tmp_path, self_check=False)
    checkpoint = resolve_checkpoint(tmp_path)
    assert not (checkpoint / FILE).exists()
    assert compare(MMEPolicy.from_pretrained(checkpoint), checkpoint) is None


def test_a_check_that_fails_loses_no_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(policy: object) -> None:
        raise RuntimeError("cannot see")

    monkeypatch.setattr("mme_vla.policy.self_check.record_self_check", fail)
    built = train(tmp_path)
    assert built.unchecked is not None and "cannot see" in built.unchecked
    assert not (resolve_checkpoint(tmp_path) / FILE).exists()
