"""`mme-vla docs --output` replaces sites that it built, and nothing else."""

from pathlib import Path

import pytest

from mme_vla.cli.docs import MARK, check_output
from mme_vla.errors import UserError


@pytest.mark.parametrize("content", ["thesis.txt", ".hidden", "index.html", "folder/note.md"])
def test_a_folder_with_something_of_the_users_is_refused_and_kept(content: str, tmp_path: Path) -> None:
    file = tmp_path / "site" / content
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    with pytest.raises(UserError, match="which building would delete"):
        check_output(tmp_path / "site")
    assert file.read_text() == "mine"


def test_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "site").write_text("mine")
    with pytest.raises(UserError, match="something else"):
        check_output(tmp_path / "site")


def test_a_new_an_empty_and_an_earlier_site_are_accepted(tmp_path: Path) -> None:
    check_output(tmp_path / "new")
    (tmp_path / "empty").mkdir()
    check_output(tmp_path / "empty")
    (tmp_path / "empty" / MARK).touch()
    (tmp_path / "empty" / "index.html").touch()
    check_output(tmp_path / "empty")
