"""How a command ends: exit codes and one-line messages of user errors, signals and full disks."""

import os
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from mme_vla.errors import ERROR, UserError, printable
from mme_vla.utils.io import disk_trouble

DISK_TROUBLE, MISTAKE = 1, 2  # exit codes; a signal's is 128 and its number, as a shell has it


class Terminated(KeyboardInterrupt):
    """SIGTERM, which a scheduler sends before it kills; handled like Ctrl-C."""


@contextmanager
def print_user_errors() -> Iterator[None]:
    """Surround a command: what is not a bug ends the process with a message instead of a traceback.

    A `UserError` ends with code 2, a disk that refuses (full, read-only, too many files) with 1,
    Ctrl-C with 130 and SIGTERM with 143. Where the reader of standard output closes it, as `| head`
    does, the command ends quietly. Other exceptions pass.
    """
    # As standard error does: a letter that the terminal's locale lacks is spelled out.
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")
    with _terminable():
        try:
            yield
        except BrokenPipeError:
            # Standard output is a pipe whose other end is closed, or another pipe broke.
            poll = select.poll()
            poll.register(sys.stdout, 0)
            if not any(event & select.POLLERR for _, event in poll.poll(0)):
                raise
        except (Exception, KeyboardInterrupt) as error:
            # A signal, also one that an exception hides: a `finally` that fails on half-made
            # objects replaces it.
            stop: BaseException | None = error
            while stop is not None:
                if isinstance(stop, KeyboardInterrupt):
                    name, number = "Ctrl-C", signal.SIGINT
                    if isinstance(stop, Terminated):
                        name, number = "SIGTERM", signal.SIGTERM
                    _print(
                        f"Stopped by {name}. What was finished is kept: the same command continues"
                        " from there.",
                        "Stopped",
                    )
                    raise SystemExit(128 + number) from None
                stop = stop.__context__
            code = DISK_TROUBLE
            message = disk_trouble(error)
            if isinstance(error, UserError):
                code = MISTAKE
                message = str(error)
            if message is None:
                raise
            _print(f"{ERROR}{message}", ERROR)
            raise SystemExit(code) from None
        finally:
            try:
                sys.stdout.flush()
            except BrokenPipeError:  # what is still to be written has no reader
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _terminable() -> Iterator[None]:
    """Turn SIGTERM into an exception while this is open, where the process would just have died of
    it.
    """
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def terminate(number: int, frame: FrameType | None) -> None:
        raise Terminated

    signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _print(text: str, bold: str) -> None:
    from rich.console import Console
    from rich.text import Text

    shown = Text(printable(text))
    shown.highlight_regex(f"(?m)^{bold}", "bold red")
    try:
        Console(stderr=True, soft_wrap=True).print(shown)
    except OSError:  # the terminal, or the disk that standard error goes to, is what gave way
        sys.stderr = None
