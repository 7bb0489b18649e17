"""One process at a time in a folder, and work folders that a repeated command recognises.

`flock` and not the package `filelock`: that empties the file which names the holder before it knows whether the folder
is free, and a forked worker keeps its lock when the process is killed.
"""

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
_held_descriptors: set[int] = set()


def _release_in_child() -> None:
    """Close the locks of the parent in a forked process, which would hold the folder when the parent is gone."""
    while _held_descriptors:
        os.close(_held_descriptors.pop())


os.register_at_fork(after_in_child=_release_in_child)


class FolderLock:
    """Lock a folder for this process, as a context manager or from `acquire()` to `release()`.

    The lock is a file in the folder. `release` removes it, and the folder if nothing else is in it. After a kill the
    file stays, unlocked.

    Args:
        folder: made if need be. what: its purpose, for the message. name: of the file, where several share a folder.
    """

    def __init__(self, folder: Path, what: str = "run", name: str = LOCK) -> None:
        self.folder, self.what, self.path = Path(folder), what, Path(folder) / name
        self._descriptor: int | None = None

    def acquire(self) -> Self:
        """Lock the folder; raises an error that names the process which has locked it."""
        for _ in range(100):
            self.folder.mkdir(parents=True, exist_ok=True)
            try:
                descriptor = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
            except FileNotFoundError:  # the process before has just removed the folder
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
            _held_descriptors.add(descriptor)
            if self._in_place():
                break
            self._close()  # the process before removed the file between opening and locking
        with suppress(OSError):  # a full disk: the lock holds without its text
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        return self

    def release(self) -> None:
        """Unlock the folder; harmless if it is not locked."""
        if self._descriptor not in _held_descriptors:
            return
        with suppress(OSError):  # the folder may have been moved or removed meanwhile
            if self._in_place():
                self.path.unlink()
                self.folder.rmdir()
        self._close()

    def _in_place(self) -> bool:
        """Whether the locked file is still the one under the lock's name."""
        assert self._descriptor is not None
        with suppress(FileNotFoundError):
            return os.path.samestat(os.fstat(self._descriptor), self.path.stat())
        return False

    def _close(self) -> None:
        assert self._descriptor is not None
        _held_descriptors.remove(self._descriptor)
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

    A folder without any work is free, whatever a killed run left while it wrote its plan.

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
            pass  # cut off when the machine went down: free, if there is no work yet
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
