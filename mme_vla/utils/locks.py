"""One process at a time in a folder, and work folders that a repeated command recognises."""

import errno
import os
import shutil
import socket
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from filelock import FileLock, Timeout

from mme_vla.errors import UserError
from mme_vla.utils.io import is_draft, name_place, read_json, write_json

LOCK = ".lock"
_ATTEMPTS = 100  # to make and lock a folder that others remove
# errors of a file system without locks
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK)


class FolderLock:
    """Lock a folder for this process, as a context manager or from `acquire()` to `release()`.

    The lock is a file in the folder. `release` removes it, and the folder if nothing else is in it.
    After a kill the file stays, unlocked. A forked process does not have its parent's lock.
    Deleting the object unlocks the folder.

    Args:
        folder: made if need be.
        what: its purpose, for the message.
        name: of the file, where several share a folder.
    """

    def __init__(self, folder: Path, what: str = "run", name: str = LOCK) -> None:
        self.folder = Path(folder)
        self.what = what
        self.path = self.folder / name
        # A second attempt counts where the process before removes the file between opening and
        # locking it.
        self._lock = FileLock(
            self.path, timeout=0.1, poll_interval=0.02, thread_local=False, fallback_to_soft=False
        )
        self._inode: int | None = None  # of the folder that is locked

    def acquire(self) -> Self:
        """Lock the folder; raises an error that names the process which has locked it."""
        for attempt in range(_ATTEMPTS):
            self.folder.mkdir(parents=True, exist_ok=True)
            try:
                self._lock.acquire()
                break
            except FileNotFoundError:  # the process before has just removed the folder
                if attempt == _ATTEMPTS - 1:
                    raise
            except Timeout:
                # What the lock's file says of the process that has it.
                try:
                    text = self.path.read_text(errors="replace", encoding="utf-8")[:200].strip()
                    holder = text or "a process that has just started"
                except OSError:
                    holder = "a process that has just ended"
                raise UserError(
                    f"{self.folder} is in use by another {self.what} ({holder}). "
                    "Wait until it has ended, stop it, or write to another folder."
                ) from None
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                return self
        self._inode = self.folder.stat().st_ino
        with suppress(OSError):  # a full disk: the lock holds without its text
            self.path.write_text(
                f"process {os.getpid()} on {socket.gethostname()}", encoding="utf-8"
            )
        return self

    def release(self) -> None:
        """Unlock the folder; harmless if this process has not locked it."""
        if not self._lock.is_locked:
            return
        with suppress(OSError):  # the folder may have been moved or removed meanwhile
            self.path.unlink()
            self.folder.rmdir()
        self._lock.release()

    def __enter__(self) -> Self:
        return self.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        name_place(error, self.folder)
        is_same = self._inode is None or (
            self.folder.exists() and self.folder.stat().st_ino == self._inode
        )
        self.release()
        if not is_same and isinstance(error, FileNotFoundError | None):
            raise UserError(
                f"{self.folder} was removed or moved while this {self.what} was writing to it, so"
                " files are missing. Remove what is there now, and repeat the same command."
            ) from error


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
    record = folder / PLAN
    if record.exists():
        try:
            stored = read_json(record, "the plan of a command's work", kind=(dict, list))
        except UserError:
            pass  # cut off when the machine went down: free, if there is no work yet
        else:
            return bool(stored == plan)
    for path in folder.iterdir():
        if path.name in (PLAN, LOCK) or is_draft(path):
            continue
        if not path.is_dir() or any(path.iterdir()):
            return False
    write_json(record, plan, indent=1)
    return True


def drop_plan(folder: Path, *work: str) -> None:
    """Remove a plan's work, the plan last: a removal that was cut off is recognised, and repeated.

    Whatever else lies in the folder stays, and the folder with it. Otherwise the
    release of its lock, which the caller holds, removes it.

    Args:
        work: patterns, relative to the folder, of what the command writes there: `episodes/*.h5`,
            `merged`.
    """
    parents: set[Path] = set()
    for pattern in work:
        parents.update(Path(pattern).parents)
        for path in list(folder.glob(pattern)):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
    parents.discard(Path())
    for parent in sorted(parents, reverse=True):  # inner ones first
        with suppress(OSError):  # something else lies in it, or it is not there
            (folder / parent).rmdir()
    (folder / PLAN).unlink(missing_ok=True)
