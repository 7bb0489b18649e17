"""Files of `torch.save`: whatever is wrong with one, reading it raises one clear error and runs
nothing.
"""

import os
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch

from mme_vla.errors import UserError
from mme_vla.weights.source import open_source
from mme_vla.weights.torch_files import read_torch_file

TABLE = {"model": {"a.weight": torch.ones(4, 3), "a.bias": torch.zeros(4)}}


class Shell:
    """An object whose unpickling would create a file."""

    def __init__(self, place: Path) -> None:
        self.place = place

    def __reduce__(self) -> Any:
        return (os.mkdir, (str(self.place),))


def write_zip(path: Path) -> bytes:
    torch.save(TABLE, path)
    return path.read_bytes()


def write_old(path: Path) -> bytes:
    torch.save(TABLE, path, _use_new_zipfile_serialization=False)
    return path.read_bytes()


def test_both_layouts_are_read(tmp_path: Path) -> None:
    for write in (write_zip, write_old):
        write(tmp_path / "w.pth")
        for mapped in (False, True):
            tensors = read_torch_file(tmp_path / "w.pth", mapped)
            assert set(tensors) == {"a.weight", "a.bias"} and tensors["a.weight"].sum() == 12


def test_what_is_no_tensor_is_named_with_the_part_it_is_of(tmp_path: Path) -> None:
    torch.save({"a": {"step": 3}, "b": {"rate": 0.5}}, tmp_path / "w.pth")
    with pytest.raises(UserError, match=r"no table of tensors, but a\.step, b\.rate"):
        read_torch_file(tmp_path / "w.pth")


@pytest.mark.parametrize("read", [read_torch_file, open_source])
@pytest.mark.parametrize(
    "damage",
    ["empty", "cut", "old cut", "old", "text", "number", "list", "object", "pipe", "folder"],
)
def test_damaged_file_raises_one_error(tmp_path: Path, damage: str, read: Any) -> None:
    path = tmp_path / "w.pth"
    if damage == "pipe":
        os.mkfifo(path)
    elif damage == "folder":
        path.mkdir()
    elif damage in ("number", "list"):
        torch.save(3 if damage == "number" else [torch.ones(2)], path)
    elif damage == "object":
        path.write_bytes(pickle.dumps(Shell(tmp_path / "made")))
    else:
        old = write_old(path)
        content = {
            "empty": b"",
            "cut": write_zip(path)[:-200],
            "old cut": old[:-8],
            "old": old[:30] + b"e" + old[31:],
            "text": b"<html>Not found</html>",
        }[damage]
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"w\.pth") as caught:
        read(path)
    assert len(str(caught.value)) < 600
    assert not (tmp_path / "made").exists()
