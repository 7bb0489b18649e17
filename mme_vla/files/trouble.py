"""What the disk refuses, in words: no room, a file too large, no permission, too many files open."""

import errno
import os
import re
from pathlib import Path

# "errno = 28" (HDF5), "os error 28" (Rust)
_NUMBER = re.compile(r"\b(?:errno|os error)(?: ?= ?| )(\d+)\b", re.IGNORECASE)
_NAME = re.compile(r"\bname = '([^']+)'")  # HDF5
# NumPy counts what it could not write and does not say why.
_SHORT_WRITE = re.compile(r"\d+ requested and \d+ written")
_AGAIN = "and repeat the same command: what was finished is kept."
_PERMIT = "Change the permissions of it or its folder, or choose another, and repeat the same command."
_ADVICE = {
    errno.ENOSPC: ("there is no room left for it", f"Free some room {_AGAIN}"),
    errno.EDQUOT: ("your share of the disk is used up", f"Free some room {_AGAIN}"),
    errno.EFBIG: ("it would be larger than files may be here", f"Raise that limit (see `ulimit -f`) {_AGAIN}"),
    errno.EROFS: ("its disk can only be read", "Choose another folder, or make that one writable, and repeat."),
    errno.EACCES: ("permission is denied", _PERMIT),
    errno.EPERM: ("that is not permitted", _PERMIT),
    errno.EMFILE: ("too many files are open", f"Raise that limit (`ulimit -n 4096`) {_AGAIN}"),
    errno.ENFILE: ("the system has too many files open", f"Close other programs {_AGAIN}"),
    errno.EIO: ("its disk does not answer", f"Look after the disk {_AGAIN}"),
}


def disk_trouble(error: BaseException) -> str | None:
    """One sentence on what the disk refused and what to do; None if this error, or what caused it, is another matter.

    Libraries wrap such errors in their own: the number is looked for in their texts and in what they were raised from.
    """
    found, place, seen = None, None, set[int]()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        found = _number(current) if found is None else found
        place = getattr(current, "filename", None) or place
        if place is None and found is not None and (named := _NAME.search(str(current))):
            place = named[1]
        current = current.__cause__ or current.__context__
    if found is None or (place is None and found in (errno.EACCES, errno.EPERM)):  # a port, not a file
        return None
    reason, advice = _ADVICE[found]
    return f"{place or Path.cwd()} cannot be written or opened: {reason} ({os.strerror(found)}). {advice}"


def name_place(error: BaseException | None, place: Path) -> None:
    """Note where an error of the disk happened, if it does not say: those of writing to an open file never do."""
    if error is not None and not getattr(error, "filename", None) and _number(error) is not None:
        error.filename = str(place)  # type: ignore[attr-defined]


def _number(error: BaseException) -> int | None:
    """The system's number of an error that `_ADVICE` knows."""
    number = getattr(error, "errno", None)
    if isinstance(number, int) and number in _ADVICE:
        return number
    if not isinstance(error, Exception) or isinstance(error, ValueError | TypeError | LookupError):
        return None
    if isinstance(error, OSError) and _SHORT_WRITE.search(str(error)):
        return errno.ENOSPC
    for match in _NUMBER.finditer(str(error)):
        if int(match[1]) in _ADVICE:
            return int(match[1])
    return None
