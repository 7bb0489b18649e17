"""What a name of a checkpoint means: a folder on this machine, or a repository of the hub."""

from pathlib import Path

import pytest

from mme_vla.errors import UserError
from mme_vla.policy.run_folders import locate_checkpoint, shipped_checkpoints, shipped_name


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
