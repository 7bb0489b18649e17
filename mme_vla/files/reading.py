"""The one reader of text and JSON. Whatever lies in a file's place, the answer is its content or one clear sentence."""

import json
import math
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from mme_vla.errors import UserError, brief

_KINDS: dict[type, str] = {dict: "an object", list: "a list", str: "a text"}

TEXT_LIMIT = 64 * 2**20  # bytes; the largest files of text here, tables of subgoals and statistics, stay far below


def read_bytes(path: Path, what: str = "data", limit: int = TEXT_LIMIT) -> bytes:
    """Read a regular file of at most `limit` bytes.

    Raises:
        UserError: it is missing, a folder, a device or a pipe (which could block or never end), too large.
    """
    try:
        # A pipe without a writer would block in open(); a device would never end.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(descriptor, "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise UserError(f"{path} is not a file; expected {what}.")
            if found.st_size > limit:
                raise UserError(f"{path} has {found.st_size:,} bytes; {what} has at most {limit:,}.")
            return file.read(found.st_size + 1)  # reading `limit` would allocate it, whatever the size
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; expected {what}.") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        reason = "a folder" if isinstance(error, IsADirectoryError) else getattr(error, "strerror", None) or error
        raise UserError(f"{path} cannot be read as {what}: {reason}.") from None


def read_text(path: Path, what: str = "text", limit: int = TEXT_LIMIT) -> str:
    """Read a regular file of UTF-8 text of at most `limit` bytes; see `read_bytes`.

    Raises:
        UserError: as `read_bytes`, or it is not UTF-8.
    """
    data = read_bytes(path, what, limit)
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is damaged: byte {error.start:,} is not UTF-8 text; expected {what}.") from None


def is_text(value: object) -> bool:
    """Whether a value is text that can be written and tokenised: JSON's escapes allow half characters, UTF-8 does not.

    >>> is_text("\ud800")
    False
    """
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def parse_json(text: str | bytes, source: str, kind: type | tuple[type, ...] = dict, finite: bool = True) -> Any:
    """Parse JSON that somebody else wrote.

    Args:
        text: the JSON.
        source: where it came from, for the message.
        kind: what the outermost value must be.
        finite: whether NaN and infinities, which JSON does not have but Python writes, are refused.

    Raises:
        UserError: not JSON, nested too deeply, a number out of range, or another kind of value.
    """
    try:
        # Python's own constants are looked at only where they are refused: hooks slow the parser down.
        value = json.loads(text, parse_float=_finite, parse_constant=_no_constant) if finite else json.loads(text)
    except RecursionError:
        raise UserError(f"{source} is nested too deeply to be JSON of this library.") from None
    except (ValueError, OverflowError) as error:  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise UserError(f"{source} is not valid JSON: {brief(str(error), 200, quote=False)}.") from None
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or ".join(_KINDS.get(k, k.__name__) for k in kinds)
        raise UserError(f"{source} must hold {wanted}, not {brief(value)}.")
    return value


def read_json(
    path: Path, what: str = "JSON", kind: type | tuple[type, ...] = dict, limit: int = TEXT_LIMIT, finite: bool = True
) -> Any:
    """Read a file of JSON; see `read_text` and `parse_json`.

    Raises:
        UserError: it is not there or is not what it should be.
    """
    return parse_json(read_text(path, what, limit), str(path), kind, finite)


def read_json_lines(
    path: Path, what: str = "lines of JSON", limit: int = TEXT_LIMIT, finite: bool = True
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield (line number from 1, object) for every line that is not empty.

    Raises:
        UserError: as `read_json`, naming the line.
    """
    # Not splitlines(): a JSON text may hold U+2028, which is no line end in a file.
    for number, line in enumerate(read_text(path, what, limit).split("\n"), start=1):
        if line.strip():
            yield number, parse_json(line, f"{path}, line {number}", finite=finite)


def _finite(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"the number {brief(text)} is out of range")
    return value


def _no_constant(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a number")
