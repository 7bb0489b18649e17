"""The command that trains the small tower: scenes that cannot be built are left out, and said."""

import logging
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla import UserError
from mme_vla.cli.vision_pretrain import run
from mme_vla.config.composition import compose
from mme_vla.envs.scene.placement import SceneError
from mme_vla.nano import pretraining, scenes


def draw(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, buildable: set[int]) -> Any:
    def record(folder: Path, task: str, seed: int, *_: object) -> Path:
        if seed - 9_000_000 not in buildable:
            raise SceneError(f"{task}, seed {seed}: target 3 finds no place.")
        return folder / f"{task}-{seed}.npz"

    monkeypatch.setattr(scenes, "record_scenes", record)
    monkeypatch.setattr(pretraining, "pretrain", lambda tower, grid, files, *_: [file.name for file in files])
    return run(compose("vision_pretrain", ["tasks=[StopCube]", "scenes=3", f"output={tmp_path}"]))


def test_a_scene_that_cannot_be_built_is_left_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "mme_vla.nano"):
        assert draw(monkeypatch, tmp_path, {0, 2}) == ["StopCube-9000000.npz", "StopCube-9000002.npz"]
    assert "left out: StopCube, seed 9000001" in caplog.text


def test_without_any_scene_it_says_what_to_change(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="None of the 3 scenes can be built: change first_seed=9000000"):
        draw(monkeypatch, tmp_path, set())
