"""One process at a time in a folder. The operating system lets go when the process ends, however it ends."""

import errno
import fcntl
import os
import shutil
import socket
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mme_vla.errors import UserError
from mme_vla.utils.io import is_draft, name_place, read_json, remove_drafts, write_json

LOCK = ".lock"
_locked: set[int] = set()  # descriptors


def _release_all() -> None:
    """A forked process holds nothing: it would continue holding the folder when this process is gone."""
    while _locked:
        os.close(_locked.pop())


os.register_at_fork(after_in_child=_release_all)


class FolderLock:
    """Hold a folder for this process, as a context manager or from `acquire()` to `release()`.

    The lock is the file `.lock` in the folder. Whoever lets go removes it, and the folder too if nothing else is in it;
    after a kill it stays behind, without meaning.

    Args:
        folder: made if need be. what: it is for, in the message.
        name: of the lock's file, where several kinds of holders share a folder.
    """

    def __init__(self, folder: Path, what: str = "run", name: str = LOCK) -> None:
        self.folder, self.what, self.path = Path(folder), what, Path(folder) / name
        self._descriptor: int | None = None

    def acquire(self) -> Self:
        """Take the lock, making the folder if need be."""
        for last in (False,) * 99 + (True,):
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            except FileNotFoundError:  # its last holder has just removed the folder
                if last:
                    raise
                continue
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                holder = os.pread(descriptor, 200, 0).decode(errors="replace").strip()
                os.close(descriptor)
                if error.errno not in (errno.EAGAIN, errno.EACCES):  # a file system without locks
                    return self
                raise UserError(
                    f"{self.folder} is in use by another {self.what} ({holder or 'a process that has just started'}). "
                    "Wait until it has ended, stop it, or write to another folder."
                ) from None
            self._descriptor = descriptor
            _locked.add(descriptor)
            if self._in_place():
                break
            self._forget()  # what we hold was removed by its last holder between our opening and our locking it
        try:
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        except OSError:  # a full disk: the lock holds without words
            pass
        return self

    def release(self) -> None:
        """Let go of the folder; harmless if it is not held."""
        if self._descriptor not in _locked:
            return
        with suppress(OSError):  # the folder may have been moved or removed by its holder
            if self._in_place():
                self.path.unlink()
                self.folder.rmdir()
        self._forget()

    def _in_place(self) -> bool:
        """Whether the file that is locked is still the one under the lock's name."""
        assert self._descriptor is not None
        try:
            return os.path.samestat(os.fstat(self._descriptor), self.path.stat())
        except FileNotFoundError:
            return False

    def _forget(self) -> None:
        if self._descriptor in _locked:  # not so in a forked process
            _locked.remove(self._descriptor)
            os.close(self._descriptor)
        self._descriptor = None

    def __enter__(self) -> Self:
        return self.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        name_place(error, self.folder)
        self.release()


PLAN = "plan.json"


def claim_plan(folder: Path, plan: Any) -> bool:
    """Make `folder` the work folder of a plan, or recognise it as such. The caller holds its lock.

    A folder without any work is nobody's, whatever a run left that was killed while it wrote its plan.

    Args:
        plan: plain JSON, an object or a list.

    Returns:
        Whether the folder is this plan's; False where it holds something else.
    """
    folder.mkdir(parents=True, exist_ok=True)
    record, about = folder / PLAN, "the plan of a command's work"
    if record.exists():
        try:
            if read_json(record, about, kind=(dict, list)) == plan:
                remove_drafts(folder)
                return True
        except UserError:
            pass  # cut off when the machine went down: nobody's, if there is no work yet
        else:
            return False
    if any(_is_work(path) for path in folder.iterdir()):
        return False
    remove_drafts(folder)
    write_json(record, plan, indent=1)
    return True


def drop_plan(folder: Path) -> None:
    """Remove a plan's work folder, the plan last: a removal that was cut off is recognised, and repeated.

    The caller holds the folder's lock, whose release removes the folder itself.
    """
    for path in folder.iterdir():
        if path.name not in (PLAN, LOCK):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    (folder / PLAN).unlink(missing_ok=True)


def _is_work(path: Path) -> bool:
    if path.name in (PLAN, LOCK) or is_draft(path):
        return False
    return not path.is_dir() or any(path.iterdir())
