"""Folders as `.tar.xz` archives with the same bytes whenever and wherever they are packed, and
commands in process.
"""

import io
import os
import runpy
import sys
import tarfile
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest import mock

import mme_vla

PACKAGE_PATH = Path(mme_vla.__file__).resolve().parents[1]
"""Where the library was imported from: the clone, or the packages of an environment."""


def pack(folder: Path, archive: Path) -> None:
    """Pack the files below a folder, without times and owners."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    # Equal names side by side: the same tokenizer in every checkpoint is then stored once.
    files.sort(key=lambda path: (path.name, path))
    with tarfile.open(archive, "w:xz", preset=9) as tar:
        for path in files:
            member = tarfile.TarInfo(path.relative_to(folder).as_posix())
            member.size = path.stat().st_size
            with path.open("rb") as file:
                tar.addfile(member, file)


def unpack(archive: Path, folder: Path) -> Path:
    """Unpack an archive; the folder."""
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    return folder


class EndedError(RuntimeError):
    """A command ended with another exit code than 0."""


def run(*arguments: str | Path) -> tuple[int, str, str]:
    """Run `mme-vla <arguments>` in this process; its exit code, standard output and
    standard error.
    """
    out, err, code = io.StringIO(), io.StringIO(), 0
    with (
        mock.patch.object(sys, "argv", ["mme-vla", *map(str, arguments)]),
        mock.patch.dict(os.environ, COLUMNS="200", NO_COLOR="1"),
        redirect_stdout(out),
        redirect_stderr(err),
    ):
        try:
            runpy.run_module("mme_vla", run_name="__main__")
        except SystemExit as end:
            if isinstance(end.code, str):
                print(end.code, file=sys.stderr)
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return code, out.getvalue(), err.getvalue()


def command(*arguments: str | Path) -> str:
    """Run a command that must succeed; what it prints to standard output."""
    code, out, err = run(*arguments)
    if code:
        raise EndedError(f"{' '.join(map(str, arguments))} ended with {code}: {err[-2000:]}")
    return out


@contextmanager
def inside(folder: Path) -> Iterator[None]:
    """Work in a folder."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
