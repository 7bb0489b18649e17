"""Stops a forked process before its n-th change of a file below a folder, whoever asks for it: Python, HDF5, FFmpeg.

Linux on x86-64: a seccomp filter hands the system calls that change files to this process, which is the tracer
(ptrace). Threads and child processes are followed; only changes that the process itself makes are counted. Not seen:
half of a single write, memory-mapped writing, what a power cut takes from the disk's own cache.
"""

import ctypes
import os
import signal
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

_LIBC = ctypes.CDLL(None, use_errno=True)
_TRACEME, _GETREGS, _CONT, _SETOPTIONS = 0, 12, 7, 0x4200
_FOLLOW = 0x2 | 0x4 | 0x8 | 0x80 | 0x100000  # fork, vfork, clone, seccomp; end with the tracer
_NO_NEW_PRIVS, _SET_SECCOMP, _FILTER = 38, 22, 2
_ALLOW, _TRACE = 0x7FFF0000, 0x7FF00000
_AT_FDCWD = -100
_GRACE = 5.0
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC

# name: (number, how its path is found)
_CALLS = {
    "open": (2, "path0"), "openat": (257, "at01"), "creat": (85, "path0"), "write": (1, "fd0"), "pwrite64": (18, "fd0"),
    "writev": (20, "fd0"), "pwritev": (296, "fd0"), "truncate": (76, "path0"), "ftruncate": (77, "fd0"),
    "fallocate": (285, "fd0"), "fsync": (74, "fd0"), "fdatasync": (75, "fd0"), "rename": (82, "path1"),
    "renameat": (264, "at23"), "renameat2": (316, "at23"), "unlink": (87, "path0"), "unlinkat": (263, "at01"),
    "mkdir": (83, "path0"), "mkdirat": (258, "at01"), "rmdir": (84, "path0"), "link": (86, "path1"),
    "linkat": (265, "at23"), "symlink": (88, "path1"), "symlinkat": (266, "at12"),
}  # fmt: skip
_BY_NUMBER = {number: (name, how) for name, (number, how) in _CALLS.items()}


@dataclass
class Traced:
    """What became of a traced process: the changes it asked for, its exit code, and who outlived it."""

    changes: list[str] = field(default_factory=list)
    code: int | None = None
    outlived: int = 0


def trace(work: Callable[[], object], folder: Path, kill_at: int | None = None, limit_s: float = 120) -> Traced:
    """Run `work` in a forked process, and kill that before its change number `kill_at` (from 1) below `folder`.

    Raises:
        OSError: this system does not allow it. TimeoutError: `limit_s` is over.
    """
    main = os.fork()
    if main == 0:
        _be_traced(work)
    traced, below, alive = Traced(), str(folder.resolve()), {main}
    signal.signal(signal.SIGALRM, _over)
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    try:
        os.waitpid(main, 0)
        _ptrace(_SETOPTIONS, main, 0, _FOLLOW)
        _ptrace(_CONT, main, 0, 0)
        _follow(main, alive, traced, below, kill_at)
    except _TimeIsOverError:
        traced.outlived = len({_group(task) for task in alive} - {main, 0})
        for task in alive:
            _kill(task)
        if traced.code is None:
            raise TimeoutError(f"still running after {limit_s:g} s") from None
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return traced


class _TimeIsOverError(Exception):
    """The time is over."""


def _over(*_: object) -> None:
    raise _TimeIsOverError


def _follow(main: int, alive: set[int], traced: Traced, below: str, kill_at: int | None) -> None:
    """Answer every stop of these tasks until all have ended; what outlives the main process has `_GRACE` seconds."""
    while alive:
        try:
            task, status = os.waitpid(-1, 0x40000000)  # __WALL: threads as well
        except ChildProcessError:
            break
        if os.WIFEXITED(status) or os.WIFSIGNALED(status):
            alive.discard(task)
            if task == main:
                traced.code = os.waitstatus_to_exitcode(status)
                signal.setitimer(signal.ITIMER_REAL, _GRACE)
            continue
        alive.add(task)
        passed_on = os.WSTOPSIG(status)
        if status >> 8 == signal.SIGTRAP | 7 << 8:  # a call of the filter
            change = _change(task, below)
            if change is not None and _group(task) == main:
                traced.changes.append(change)
                if len(traced.changes) == kill_at:
                    os.kill(main, signal.SIGKILL)
                    continue
            passed_on = 0
        elif status >> 16 or passed_on in (signal.SIGTRAP, signal.SIGSTOP):  # a new thread or process
            passed_on = 0
        _ptrace(_CONT, task, 0, passed_on, gone_is_fine=True)


def _be_traced(work: Callable[[], object]) -> None:
    try:
        _ptrace(_TRACEME, 0, 0, 0)
        os.kill(os.getpid(), signal.SIGSTOP)
        _filter_calls()
        work()
        sys.stdout.flush()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
        code = 99
    os._exit(code)


def _filter_calls() -> None:
    numbers = sorted(number for number, _ in _CALLS.values())
    code = [(0x20, 0, 0, 0)]  # load the call's number
    code += [(0x15, len(numbers) - i, 0, number) for i, number in enumerate(numbers)]
    code += [(0x06, 0, 0, _ALLOW), (0x06, 0, 0, _TRACE)]
    program = b"".join(struct.pack("HBBI", *line) for line in code)
    buffer = ctypes.create_string_buffer(program)
    header = struct.pack("HxxxxxxP", len(code), ctypes.addressof(buffer))
    if _LIBC.prctl(_NO_NEW_PRIVS, 1, 0, 0, 0) or _LIBC.prctl(_SET_SECCOMP, _FILTER, header, 0, 0):
        raise OSError(ctypes.get_errno(), "this system allows no filter of system calls")


def _change(task: int, below: str) -> str | None:
    """`write metrics.jsonl`, if the call that `task` is about to make changes something below the folder."""
    registers = (ctypes.c_ulonglong * 27)()
    try:
        _ptrace(_GETREGS, task, 0, ctypes.addressof(registers))
        name, how = _BY_NUMBER[registers[15]]
        arguments = [registers[i] for i in (14, 13, 12, 7)]  # rdi, rsi, rdx, r10
        if name in ("open", "openat") and not arguments[1 if name == "open" else 2] & _WRITING:
            return None
        if how == "fd0":
            path = str(Path(f"/proc/{task}/fd/{arguments[0]}").readlink())
        elif how.startswith("path"):
            path = _absolute(task, _AT_FDCWD, arguments[int(how[4])])
        else:
            path = _absolute(task, ctypes.c_int(arguments[int(how[2])]).value, arguments[int(how[3])])
    except OSError:  # it was killed meanwhile
        return None
    path = os.path.normpath(path)
    if not path.startswith(below):
        return None
    return f"{name} {path.removeprefix(below).lstrip('/')}"


def _absolute(task: int, folder: int, address: int) -> str:
    with Path(f"/proc/{task}/mem").open("rb", buffering=0) as memory:
        memory.seek(address)
        text = b""
        while b"\0" not in text and len(text) < 4096:
            piece = memory.read(4096 - (address + len(text)) % 4096)  # never beyond a page that may be the last
            if not piece:
                break
            text += piece
    name = os.fsdecode(text.partition(b"\0")[0])
    base = f"/proc/{task}/cwd" if folder == _AT_FDCWD else f"/proc/{task}/fd/{folder}"
    return name if name.startswith("/") else str(Path(base).readlink() / name)


def _group(task: int) -> int:
    """The process that a thread belongs to; 0 if it is gone."""
    try:
        lines = Path(f"/proc/{task}/status").read_text().splitlines()
    except OSError:
        return 0
    return next(int(line.split()[1]) for line in lines if line.startswith("Tgid"))


def _kill(task: int) -> None:
    try:
        os.kill(task, signal.SIGKILL)
        os.waitpid(task, 0x40000000)
    except OSError:
        pass


def _ptrace(request: int, task: int, address: int, data: int, gone_is_fine: bool = False) -> None:
    _LIBC.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
    _LIBC.ptrace.restype = ctypes.c_long
    if _LIBC.ptrace(request, task, address, data) == -1 and not gone_is_fine:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
