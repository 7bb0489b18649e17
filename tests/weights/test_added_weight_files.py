"""Readers that are called directly read only what the SHA256SUMS of the folder lists, as it was
written.
"""

import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from helpers import REPOSITORY
from mme_vla.errors import UserError
from mme_vla.utils import write_sums
from mme_vla.weights.orbax import open_archive, read_orbax
from mme_vla.weights.torch_files import load_torch_file, read_torch_file

RUN = REPOSITORY / "tests" / "data" / "orbax_run"


def flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize("read", [read_torch_file, lambda path: load_torch_file(path, "weights")])
def test_a_torch_file_is_read_if_the_checksums_of_its_folder_list_and_fit_it(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / "policy.pth"
    torch.save({"layer": torch.zeros(200)}, path)
    read(path)
    (tmp_path / "other.txt").write_text("")
    write_sums(tmp_path, ["other.txt"])
    with pytest.raises(UserError, match=r"SHA256SUMS does not list policy\.pth"):
        read(path)
    write_sums(tmp_path, ["policy.pth"])
    read(path)
    flip(path)
    with pytest.raises(UserError, match=r"policy\.pth is damaged.*SHA-256"):
        read(path)


@pytest.fixture
def step(tmp_path: Path) -> Path:
    """A step of a released run."""
    pytest.importorskip("tensorstore", reason="reading Orbax checkpoints needs the extra 'orbax'")
    return Path(shutil.copytree(RUN / "100", tmp_path / "100"))


@pytest.mark.parametrize("beside", ["", "params"], ids=["step", "arrays"])
def test_orbax_arrays_are_read_if_the_checksums_beside_them_list_and_fit_each_file(
    beside: str, step: Path
) -> None:
    place = step / beside
    write_sums(place)
    assert read_orbax(step / "params")
    (step / "params" / "added").write_text("")
    with pytest.raises(UserError, match=r"SHA256SUMS does not list (params/)?added"):
        read_orbax(step / "params")
    (step / "params" / "added").unlink()
    part = max(
        (file for file in (step / "params").rglob("*") if file.is_file()),
        key=lambda file: file.stat().st_size,
    )
    flip(part)
    with pytest.raises(UserError, match=rf"{part.name} is damaged.*SHA-256"):
        read_orbax(step / "params")


def test_an_archive_is_read_if_the_checksums_beside_it_list_it(step: Path, tmp_path: Path) -> None:
    archive = tmp_path / "100.zip"
    with zipfile.ZipFile(archive, "w") as opened:
        for file in step.rglob("*"):
            opened.write(file, file.relative_to(step).as_posix())
    arrays, _ = open_archive(archive)
    write_sums(tmp_path, ["100.zip"])
    assert read_orbax(arrays)
    (tmp_path / "other.txt").write_text("")
    write_sums(tmp_path, ["other.txt"])
    with pytest.raises(UserError, match=r"does not list 100\.zip"):
        read_orbax(arrays)
