"""Where bytes go to another library's parser: what it makes of damaged ones becomes one clear sentence."""

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mme_vla.errors import UserError, brief


def require_file(path: Path, what: str = "a file") -> Path:
    """Return `path` if it is a regular file, which can be opened without waiting.

    Raises:
        UserError: it is missing, a folder, a device or a pipe.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise UserError(f"{_shown(path)} is missing; expected {what}.") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{_shown(path)} cannot be read as {what}: {brief(reason, 300, quote=False)}.") from None
    if not stat.S_ISREG(mode):
        raise UserError(f"{_shown(path)} is not a file; expected {what}.")
    return path


def _shown(path: Path) -> str:
    """A path in a message; a stranger's file may have given it a name of any length."""
    return brief(str(path), 300, quote=False)


@contextmanager
def decoding(path: Path | str, what: str, remedy: str) -> Iterator[None]:
    """Around a call into another library that parses the file `path`, and nothing else.

    Parsers of binary formats raise whatever they stumble over, from KeyError to MemoryError; there is no list of it.

    Raises:
        UserError: anything was raised.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        said = " ".join(str(error.__cause__ or error).split())  # some wrap what happened in a sentence without content
        reason = f"{type(error).__name__}: {brief(said, 200, quote=False)}" if said else type(error).__name__
        raise UserError(f"{path} is damaged: it cannot be read as {what} ({reason}). {remedy}") from error
