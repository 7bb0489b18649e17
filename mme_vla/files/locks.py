"""One process at a time in a folder. The operating system lets go when the process ends, however it ends."""

import errno
import fcntl
import os
import socket
from pathlib import Path
from types import TracebackType
from typing import Self

from mme_vla.errors import UserError

LOCK = ".lock"


class FolderLock:
    """Hold a folder for this process, as a context manager or from `acquire()` to `release()`.

    The lock is the file `.lock` in the folder; it stays behind, without meaning, when nobody holds it.

    Raises:
        UserError: another process holds the folder.
    """

    def __init__(self, folder: Path, what: str = "run") -> None:
        self.folder, self.what = Path(folder), what
        self._descriptor: int | None = None

    def acquire(self) -> Self:
        """Take the lock, making the folder if need be."""
        self.folder.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(self.folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.pread(descriptor, 200, 0).decode(errors="replace").strip()
            os.close(descriptor)
            if error.errno not in (errno.EAGAIN, errno.EACCES):  # a file system without locks
                return self
            raise UserError(
                f"{self.folder} is in use by another {self.what} ({holder or 'a process that has just started'}). Wait "
                "until it has ended, stop it, or write to another folder."
            ) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        self._descriptor = descriptor
        return self

    def release(self) -> None:
        """Let go of the folder; harmless if it is not held."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None

    def __enter__(self) -> Self:
        return self.acquire()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()
