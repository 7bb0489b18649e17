"""A checksum of every file of a folder, in the layout of `sha256sum`, which can check it as well: `sha256sum -c`."""

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from mme_vla.errors import UserError
from mme_vla.files.places import inside
from mme_vla.files.reading import read_text
from mme_vla.files.writing import write_atomically

SUMS = "SHA256SUMS"
_REMEDY = "Take an earlier checkpoint or copy the file again"
_LINE = re.compile(r"([0-9a-f]{64})  ([^\n]+)")


def file_sum(path: Path) -> str:
    """The SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sum_line(path: Path, name: str) -> str:
    """The line of a list of checksums for a file that is, or will be, called `name`."""
    return f"{file_sum(path)}  {name}\n"


def write_sums(folder: Path, names: Iterable[str] | None = None) -> None:
    """Write `SHA256SUMS` for these files of a folder, by default for all files in it and below."""
    found = (path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    chosen = sorted(set(names) if names is not None else {name for name in found if name != SUMS})
    with write_atomically(folder / SUMS) as draft:
        draft.write_text("".join(sum_line(folder / name, name) for name in chosen))


class Sums:
    """The checksums that lie beside a folder's files, read once; each file is compared at most once.

    there: whether there are any; folders written by others, or before there were sums, have none.
    """

    def __init__(self, folder: Path, name: str = SUMS, remedy: str = _REMEDY) -> None:
        """Read the list.

        Args:
            folder: a folder that may hold the list `name`. remedy: what the user can do about a damaged file.

        Raises:
            UserError: the list is damaged.
        """
        self.folder, self.name, self.remedy = folder, name, remedy
        path = folder / name
        self.there = path.exists() or path.is_symlink()
        self.table: dict[str, str] = {}
        self._compared: set[str] = set()
        for number, line in enumerate(read_text(path, "a list of checksums").splitlines() if self.there else [], 1):
            match = _LINE.fullmatch(line)
            if match is None:
                raise UserError(f"{path}, line {number} is damaged: expected a SHA-256 and a file's name.")
            self.table[match[2]] = match[1]

    def check(self, name: str) -> None:
        """Compare one file, the first time it is asked about; one that is not listed is not checked.

        Raises:
            UserError: it is missing or its content is not what was written.
        """
        if name not in self.table or name in self._compared:
            return
        path = inside(self.folder, name)
        if not path.is_file():
            raise UserError(
                f"{path} is missing, though {self.folder / self.name} lists it. Copy the whole folder again."
            )
        if file_sum(path) != self.table[name]:
            raise UserError(
                f"{path} is damaged: its content is not what was written (SHA-256 differs from {self.name}). "
                f"{self.remedy}; if you changed it on purpose, delete {self.name}."
            )
        self._compared.add(name)


def check_sums(folder: Path, names: Iterable[str] | None = None) -> bool:
    """Compare files with the sums that were written beside them.

    Args:
        folder: a folder that may hold `SHA256SUMS`.
        names: the files about to be read; by default all that are listed. Files that are not listed are not checked:
            people add notes and cards.

    Returns:
        Whether there were sums to compare with.

    Raises:
        UserError: a file is missing or its content is not what was written.
    """
    sums = Sums(folder)
    for name in sorted(sums.table) if names is None else names:
        sums.check(name)
    return sums.there
