"""A checksum of every file of a folder, in the layout of `sha256sum`, which can check it as well:
`sha256sum -c`.
"""

import hashlib
import re
from collections.abc import Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from mme_vla.errors import UserError, listed, require
from mme_vla.utils.io import inside, read_text, write_text

SUMS = "SHA256SUMS"
_AT_ONCE = 4  # files
_REMEDY = "Take an earlier checkpoint or copy the file again"
_LINE = re.compile(r"([0-9a-f]{64})  ([^\n]+)")


def file_sum(path: Path) -> str:
    """The SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sum_line(path: Path, name: str) -> str:
    """The line of a list of checksums for a file that is, or will be, called `name`."""
    return f"{file_sum(path)}  {name}\n"


def write_sums(folder: Path, names: Iterable[str] | None = None, keep: bool = False) -> None:
    """Write `SHA256SUMS` for these files of a folder, by default for all files in it and below.

    Files are read once more for it, in blocks and several at a time. With `keep`, the sums that are
    there of other files stay.
    """
    if names is None:
        paths = filter(Path.is_file, folder.rglob("*"))
        names = [path.relative_to(folder).as_posix() for path in paths]
    files = sorted(set(names) - {SUMS})
    table: dict[str, str] = {}
    if keep and (folder / SUMS).exists():
        table = _read_sums(folder / SUMS)
    with ThreadPoolExecutor(_AT_ONCE) as pool:  # hashing lets other threads run
        sums = pool.map(lambda name: file_sum(folder / name), files)
        table.update(zip(files, sums, strict=True))
    write_text(folder / SUMS, "".join(f"{table[name]}  {name}\n" for name in sorted(table)))


class Sums:
    """The checksums that lie beside a folder's files, read once; each file is compared at most
    once.

    there: whether there are any; folders written by others, or before there were sums, have none.
    """

    def __init__(self, folder: Path, name: str = SUMS, remedy: str = _REMEDY) -> None:
        """Read the list.

        Args:
            folder: a folder that may hold the list `name`.
            remedy: what the user can do about a damaged file.
        """
        self.folder, self.name, self.remedy = folder, name, remedy
        path = folder / name
        self.there = path.exists() or path.is_symlink()
        self.table = _read_sums(path) if self.there else {}
        self._compared: set[str] = set()

    def check(self, *names: str) -> None:
        """Compare these files, each the first time it is asked about; one that is not listed is not
        checked.

        Datasets have such files: rows of the user's own, results of other programs. Of checkpoints,
        `check_sums` asks.
        """
        paths = {}
        for name in names:
            if name not in self.table or name in self._compared:
                continue
            paths[name] = inside(self.folder, name)
            require(
                paths[name].is_file(),
                f"{paths[name]} is missing, though {self.folder / self.name} lists it. Copy the"
                " whole folder again.",
            )
        with ThreadPoolExecutor(_AT_ONCE) as pool:  # hashing lets other threads run
            checksums = list(pool.map(file_sum, paths.values()))
        for (name, path), checksum in zip(paths.items(), checksums, strict=True):
            require(
                checksum == self.table[name],
                f"{path} is damaged: its content is not what was written (SHA-256 differs from"
                f" {self.name}). {self.remedy}; if you changed it on purpose, delete"
                f" {self.name}.",
            )
        self._compared |= set(paths)


def check_sums(folder: Path, names: Collection[str]) -> None:
    """Compare files with the sums that were written beside them.

    Args:
        folder: a folder that may hold `SHA256SUMS`.
        names: the files about to be read, each of which must be listed where there is a list. Notes
            and cards that people add are not read, and need no line.

    Raises:
        UserError: a file is damaged, missing, or not listed: it was added after the sums were
            written.
    """
    sums = Sums(folder)
    added = [name for name in names if sums.there and name not in sums.table]
    if added:
        raise UserError(
            f"{folder / SUMS} does not list {listed(added)}, which would be read: added after the"
            f" sums were written. Remove what does not belong to {folder}. If it does, add its"
            f" line: sha256sum <file> >> {SUMS}"
        )
    sums.check(*names)


def checked_file(folder: Path, name: str, what: str = "file") -> Path:
    """The path of a file of a checkpoint that is about to be read: it lies in the folder, and its
    sum is right.

    Args:
        folder: a folder that may hold `SHA256SUMS`.
        name: relative to it.
        what: the file is, for the message.

    Raises:
        UserError: it lies outside, is damaged, or is not listed; see `check_sums`.
    """
    path = inside(folder, name, what)
    check_sums(folder, [name])
    return path


def _read_sums(sums: Path) -> dict[str, str]:
    table = {}
    for number, line in enumerate(read_text(sums, "a list of checksums").split("\n"), start=1):
        match = _LINE.fullmatch(line)
        if match is not None:
            table[match[2].removeprefix("./")] = match[1]  # as `sha256sum ./*` writes it
        elif line:
            raise UserError(
                f"{sums}, line {number} is damaged: expected a SHA-256 and a file's name."
            )
    return table
