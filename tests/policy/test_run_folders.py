"""What a name of a checkpoint means: a folder on this machine, or a repository of the hub."""

import os
from pathlib import Path

import pytest

from mme_vla.errors import UserError
from mme_vla.policy.run_folders import (
    find_run,
    locate_checkpoint,
    shipped_checkpoints,
    shipped_name,
)


def test_a_missing_run_below_a_folder_of_this_machine_is_no_repository(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs" / "small").mkdir(parents=True)
    for name in ("outputs/small/x", "outputs/other/x", str(tmp_path / "x")):
        with pytest.raises(UserError, match=f"No checkpoint at {name}"):
            locate_checkpoint(name)


@pytest.mark.parametrize("name", ["missing", "outputs/missing", "../missing"])
def test_a_missing_path_that_can_be_no_repository_is_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=f"No checkpoint at {name}: there is no such folder"):
        locate_checkpoint(name)


def test_latest_of_a_folder_without_runs_suggests_the_newest_run_of_the_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for when, model in enumerate(("pi05", "tokendrop_expert", "ttt_modul")):
        step = Path("outputs", model, "2026-01-01", "checkpoints", "step_000001")
        step.mkdir(parents=True)
        if model != "ttt_modul":
            (step / "training_state.json").touch()
        os.utime(step, (when, when))
    for name in ("latest", "outputs/latest", "elsewhere/latest"):
        with pytest.raises(UserError, match=r"Did you mean outputs/tokendrop_expert/latest\?$"):
            find_run(Path(name))


def test_a_shipped_folder_has_its_name() -> None:
    for name, folder in shipped_checkpoints().items():
        assert shipped_name(folder) == name
    assert shipped_name(Path("nano")) is None


@pytest.mark.parametrize("name", ["owner/name", "owner/name/folder"])
def test_other_missing_paths_may_be_repositories(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert locate_checkpoint(name) == name
