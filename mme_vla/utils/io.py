"""Reads and writes files: text, JSON, lines of JSON. A damaged or missing file raises one clear
error.

Checks happen when a file is opened; what a reader returns is trusted from then on.
"""

import errno
import glob
import json
import lzma
import math
import os
import re
import socket
import stat
import uuid
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError, brief, require

# What a disk refuses: a number that the system gives to an error.
_REFUSALS = frozenset(
    {
        errno.EEXIST,
        errno.ENOTDIR,
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EFBIG,
        errno.EROFS,
        errno.EACCES,
        errno.EPERM,
        errno.EMFILE,
        errno.ENFILE,
        errno.EIO,
    }
)
# Libraries that write files themselves raise errors of their own, with the number in the text:
# "errno = 28" (HDF5), "os error 28" (Rust).
_NUMBER_IN_TEXT = re.compile(r"\b(?:errno|os error)(?: ?= ?| )(\d+)\b", re.IGNORECASE)
# NumPy counts what it could not write and does not say why.
_SHORT_WRITE = re.compile(r"\d+ requested and \d+ written")


def disk_trouble(error: BaseException) -> str | None:
    """Describe an error of the disk in one sentence: the place, the system's reason, what to do.

    The error, or one that it was raised from, has the number that the system gave it.

    Returns:
        None for other errors, such as a port that may not be opened.
    """
    number: int | None = None
    place: str | None = None
    visited: list[BaseException] = []  # causes may form a circle
    current: BaseException | None = error
    while current is not None and current not in visited:
        visited.append(current)
        number = number or _refusal(current)
        place = getattr(current, "filename", None) or place
        current = current.__cause__ or current.__context__
    if number is None or (place is None and number in (errno.EACCES, errno.EPERM)):
        return None
    if place is None:
        place = f"{Path.cwd()} ({brief(str(error), 300, quote=False)})"
    return (
        f"{place} cannot be written or opened: {os.strerror(number)}. Mend that, or choose another"
        " place, and repeat the same command: what was finished is kept."
    )


def name_place(error: BaseException | None, place: Path) -> None:
    """Note where an error of the disk happened, if it does not say: those of writing to an open
    file never do.
    """
    if error is None or getattr(error, "filename", None) is not None:
        return
    if _refusal(error) is not None:
        error.filename = str(place)  # type: ignore[attr-defined]


def _refusal(error: BaseException) -> int | None:
    """The system's number of an error of the disk."""
    number = getattr(error, "errno", None)
    if number in _REFUSALS:
        return number
    text = str(error)
    if isinstance(error, OSError) and _SHORT_WRITE.search(text):
        return errno.ENOSPC
    # Messages of users' mistakes may quote such a text.
    if isinstance(error, ValueError | TypeError | LookupError):
        return None
    for match in _NUMBER_IN_TEXT.finditer(text):
        if int(match[1]) in _REFUSALS:
            return int(match[1])
    return None


def require_file(path: Path, what: str = "a file") -> Path:
    """Return `path` if it is a regular file, which can be opened without waiting."""
    name = brief(str(path), 300, quote=False)
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise UserError(f"{name} is missing; expected {what}.") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        reason = brief(_reason(error), 300, quote=False)
        raise UserError(f"{name} cannot be read as {what}: {reason}.") from None
    require(stat.S_ISREG(mode), f"{name} is not a file; expected {what}.")
    return path


def _reason(error: Exception) -> str:
    """The system's words for an error, or the error's own."""
    return getattr(error, "strerror", None) or str(error)


@contextmanager
def decoding(path: Path | str, what: str, remedy: str) -> Iterator[None]:
    """Around a call into another library that parses the file `path`, and nothing else.

    Parsers of binary formats raise whatever they stumble over, MemoryError too; there is no list of
    it. A file that may not be opened is not called damaged.
    """
    try:
        yield
    except UserError:
        raise
    except PermissionError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}.") from error
    except Exception as error:
        # some wrap what happened in a sentence without content
        message = " ".join(str(error.__cause__ or error).split())
        reason = type(error).__name__
        if message:
            reason += f": {brief(message, 200, quote=False)}"
        raise UserError(
            f"{path} is damaged: it cannot be read as {what} ({reason}). {remedy}"
        ) from error


def inside(folder: Path, name: str, what: str = "file") -> Path:
    """Return the path of `name` in `folder`, symbolic links followed.

    A snapshot in the hub's cache is made of links to the files of its repository's folder,
    `../../blobs/…`: these count as its own. So do the files of the installed library, which some
    installers link to a cache (`uv pip install --link-mode symlink`).
    """
    require(isinstance(name, str), f"{folder}: {what}={brief(name)} must be the name of a file.")
    place = folder / name
    root = folder.resolve()
    try:
        target = place.resolve()
    except (OSError, ValueError, RuntimeError):  # a null character, a loop of links
        target = Path("/")
    allowed = target.is_relative_to(root) and target != root
    climbs = ".." in Path(name).parts
    if root.is_relative_to(_PACKAGE) and not climbs:
        allowed = allowed or target.is_file()
    if not allowed and not climbs:
        # the hub's cache: <repository>/snapshots/<revision>, of which `root` is one or lies in one
        for snapshot in (root, *root.parents):
            repository = snapshot.parent.parent
            if snapshot.parent.name == "snapshots" and _HUB_REPOSITORY.match(repository.name):
                allowed = target.is_relative_to(repository / "blobs")
                break
    require(
        name and not Path(name).is_absolute() and allowed,
        f"{folder} names the {what} {brief(name)}, which lies outside of it. Nothing outside a"
        " checkpoint's or dataset's own folder is read for it; copy the file into the folder, or"
        " correct the name.",
    )
    return place


def is_vacant(folder: Path) -> bool:
    """Whether nothing lies in this place, or an empty folder."""
    if folder.is_dir():
        return not any(folder.iterdir())
    return not folder.exists()


def require_replaceable(path: Path, *suffixes: str) -> Path:
    """Return where a command is to write a file, if it destroys nothing but, perhaps, an earlier
    file of the kind.

    Args:
        suffixes: how names of such files end, such as `.html`.

    Raises:
        UserError: a folder is there, or a file whose name ends otherwise.
    """
    example = path / f"NAME{suffixes[0]}"
    require(not path.is_dir(), f"{path} is a folder: name a file, such as {example}.")
    require(
        not path.is_file() or path.suffix.lower() in suffixes,
        f"{path} exists, and its name does not end with {' or '.join(suffixes)}: it is not"
        " replaced. Choose another name, or remove it yourself.",
    )
    return path


_PACKAGE = Path(__file__).parents[1].resolve()  # of the folder: the file itself may be a link
_HUB_REPOSITORY = re.compile(r"(models|datasets|spaces)--")
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]{0,99}")


def safe_name(name: str, what: str = "name") -> str:
    """Return `name` if it can be a folder's name anywhere: letters, digits, `. _ + = -`, at most
    100 characters.
    """
    require(
        isinstance(name, str) and _SAFE_NAME.fullmatch(name),
        f"{what}={brief(name)} cannot name a folder: use at most 100 letters, digits and . _ + = -,"
        " beginning with a letter or digit.",
    )
    return name


def user_cache(kind: str) -> Path:
    """Where what can be made again is kept for this user: a folder in $MME_VLA_CACHE, else in
    ~/.cache/mme_vla.
    """
    # A user without a home folder, as in containers, has to name one.
    return Path(os.environ.get("MME_VLA_CACHE") or Path.home() / ".cache" / "mme_vla") / kind


_KINDS: dict[type, str] = {dict: "an object", list: "a list", str: "a text"}

# bytes; the largest files of text here, tables of subgoals and statistics, stay far below
TEXT_LIMIT = 64 * 2**20
LOG_LIMIT = 2**30  # bytes of a file of lines


def read_bytes(path: Path, what: str = "data", limit: int = TEXT_LIMIT) -> bytes:
    """Read a regular file of at most `limit` bytes."""
    try:
        # A pipe without a writer would block in open(); a device would never end.
        with open(
            path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)
        ) as file:
            status = os.fstat(file.fileno())
            require(stat.S_ISREG(status.st_mode), f"{path} is not a file; expected {what}.")
            require(
                status.st_size <= limit,
                f"{path} has {status.st_size:,} bytes; {what} has at most {limit:,}.",
            )
            # reading `limit` would allocate it, whatever the size
            return file.read(status.st_size + 1)
    except FileNotFoundError:
        raise UserError(f"{path} does not exist; expected {what}.") from None
    except (OSError, ValueError) as error:  # ValueError: a null character in the path
        raise UserError(f"{path} cannot be read as {what}: {_reason(error)}.") from None


# bytes that a stream's unpacker is given at once: it copies those that it leaves over
_BLOCK = 2**14


def read_unpacked(path: Path, what: str = "data", limit: int = LOG_LIMIT) -> bytes:
    """Read a file of at most `limit` bytes; a file `*.xz` is unpacked, all of its streams.

    Args:
        limit: bytes of the file, and of its unpacked content over all streams.

    Raises:
        UserError: the packed file is cut off, damaged, or something else follows its last stream.
    """
    packed = read_bytes(path, what, limit)
    if path.suffix != ".xz":
        return packed
    stream = lzma.LZMADecompressor(lzma.FORMAT_XZ)
    pieces: list[bytes] = []
    size = 0
    position = 0
    while not stream.eof or position < len(packed):
        if stream.eof:
            stream = lzma.LZMADecompressor(lzma.FORMAT_XZ)
        block = packed[position : position + _BLOCK]
        require(block, f"{path} is cut off: its last stream has no end. Copy it again.")
        with decoding(path, what, "Copy it again."):
            # one more byte shows that there is more
            piece = stream.decompress(block, limit + 1 - size)
        size += len(piece)
        require(
            size <= limit,
            f"{path} has more than {limit:,} bytes of {what}, unpacked; that is the limit.",
        )
        pieces.append(piece)
        position += len(block) - len(stream.unused_data)
        # padding between streams, by the format
        while stream.eof and packed[position : position + 4] == bytes(4):
            position += 4
    return b"".join(pieces)


def read_text(path: Path, what: str = "text", limit: int = TEXT_LIMIT) -> str:
    """Read a regular file of UTF-8 text of at most `limit` bytes; see `read_bytes`."""
    data = read_bytes(path, what, limit)
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path} is damaged: byte {error.start:,} is not UTF-8 text; expected {what}."
        ) from None


def is_text(value: object) -> bool:
    """Whether a value is text that can be written and tokenised: JSON's escapes allow half
    characters, UTF-8 does not.

    >>> is_text(chr(0xD800))
    False
    """
    if not isinstance(value, str):
        return False
    try:
        value.encode()
    except UnicodeEncodeError:
        return False
    return True


def parse_json(
    text: str | bytes, source: str, kind: type | tuple[type, ...] = dict, finite: bool = True
) -> Any:
    """Parse JSON of another program.

    Args:
        text: the JSON.
        source: where it came from, for the message.
        kind: what the outermost value must be.
        finite: whether NaN and infinities, which JSON does not have but Python writes, are refused.

    Raises:
        UserError: it is none, a key is twice in an object, or it holds another kind of value.
    """
    hooks: dict[str, Any] = {"object_pairs_hook": _each_once}
    # Python's own constants are looked at only where they are refused: hooks slow the parser down.
    if finite:
        hooks |= {"parse_float": _finite, "parse_constant": _finite}
    try:
        value = json.loads(text, **hooks)
    except RecursionError:
        raise UserError(f"{source} is nested too deeply to be JSON of this library.") from None
    except (ValueError, OverflowError) as error:  # also UnicodeDecodeError and JSONDecodeError
        reason = brief(str(error), 200, quote=False)
        raise UserError(f"{source} is not valid JSON: {reason}.") from None
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        expected = " or ".join(_KINDS.get(k, k.__name__) for k in kinds)
        raise UserError(f"{source} must hold {expected}, not {brief(value)}.")
    return value


def read_json(
    path: Path,
    what: str = "JSON",
    kind: type | tuple[type, ...] = dict,
    limit: int = TEXT_LIMIT,
    finite: bool = True,
) -> Any:
    """Read a file of JSON; see `read_text` and `parse_json`."""
    return parse_json(read_text(path, what, limit), str(path), kind, finite)


def read_lines[T](
    path: Path,
    kind: Callable[[dict[str, Any]], T],
    what: str = "lines of JSON",
    *,
    limit: int = LOG_LIMIT,
    finite: bool = True,
) -> list[T]:
    """Read a file of JSON lines, one object each: episode records, probe lines, rows, logs.

    A line's `crc32` (see `with_checksum`) is verified and removed. Empty lines are skipped. A
    half-written last line without a line end is ignored with a warning: a killed process was
    writing it. A file `*.xz` is decompressed.

    Args:
        kind: makes a value from a line's object, such as a class's `from_dict`, or `dict`.
        finite: raise an error for NaN and infinities.
    """
    # Not splitlines(): a JSON text may hold U+2028, which is no line end in a file.
    lines = read_unpacked(path, what, limit).split(b"\n")
    values = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        source = f"{path}, line {number}"
        try:
            row = verified(parse_json(line, source, finite=finite), source)
            try:
                values.append(kind(row))
            except UserError as error:
                raise UserError(f"{source}: {error}") from None
        except UserError:
            if number < len(lines):
                raise
            warnings.warn(
                f"{path}: ignored a half-written last line ({len(line)} bytes).", stacklevel=2
            )
    return values


def to_line(row: Mapping[str, Any]) -> str:
    """An object as one JSON line with its checksum, without the line end."""
    return json.dumps(with_checksum(row), ensure_ascii=False, separators=(",", ":"))


CHECKSUM = "crc32"


def with_checksum(values: Mapping[str, Any]) -> dict[str, Any]:
    """`values` and, under `crc32`, a checksum of them that does not depend on the order of keys."""
    return {**values, CHECKSUM: _crc(values)}


def verified(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """`values` without their checksum, which must fit. Values without a checksum are accepted."""
    inner = {key: value for key, value in values.items() if key != CHECKSUM}
    if CHECKSUM in values and values[CHECKSUM] != _crc(inner):
        raise UserError(
            f"{source} is not what was written: its {CHECKSUM} is {brief(values[CHECKSUM], 20)},"
            f" that of its content {_crc(inner)!r}. It is damaged; if you changed it on purpose,"
            f" remove {CHECKSUM}."
        )
    return inner


def _crc(values: Mapping[str, Any]) -> str:
    # ASCII, so that half characters, which no encoding of text takes, count as well.
    text = json.dumps(values, sort_keys=True, separators=(",", ":"))
    return f"{zlib.crc32(text.encode('ascii')):08x}"


def to_json(value: Any) -> Any:
    """`value` as JSON returns it: tuples are lists, keys are texts."""
    return json.loads(json.dumps(value))


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON, whose keys differ: of two values Python would take the last."""
    values = dict(pairs)
    if len(values) < len(pairs):
        ((key, _),) = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"the key {brief(key)} is there twice")
    return values


def _finite(text: str) -> float:
    if text in ("NaN", "Infinity", "-Infinity"):  # Python's own constants
        raise ValueError(f"{text} is not a number")
    if math.isinf(value := float(text)):
        raise ValueError(f"the number {brief(text)} is out of range")
    return value


_DRAFT = re.compile(r"\..+\.(?P<host>[^.]*)-(?P<process>\d+)-[0-9a-f]{8}\.partial")


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a draft beside `path`, which becomes `path` in one rename if the block ends well and is
    removed otherwise.

    So are drafts of `path` that killed processes left. A device or a pipe is written itself.

    >>> with write_atomically(Path("plan.json")) as draft:
    ...     draft.write_text("{}")
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        yield path
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_drafts(path.parent, glob.escape(path.name))
    draft = draft_of(path)
    try:
        yield draft
        draft.replace(path)
    except BaseException as error:
        name_place(error, path)
        draft.unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text in one rename: what was there stays until all of it is written."""
    with write_atomically(path) as draft:
        draft.write_text(text, encoding="utf-8")


def write_json(path: Path, value: Any, indent: int | None = 2) -> None:
    """Write `value` as JSON in one rename; numbers that are not finite are refused (ValueError)."""
    write_text(path, json.dumps(value, indent=indent, allow_nan=False) + "\n")


def draft_of(path: Path) -> Path:
    """Where this process writes what is to become `path`.

    Machine and process are in the name, so that a killed one's can be told, and a random number, as
    both may repeat among containers: two writers never share a draft, and the last one to finish
    wins whole.
    """
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.partial")


def is_draft(path: Path) -> bool:
    """Whether this is a draft, of whichever process."""
    return _DRAFT.fullmatch(path.name) is not None


def remove_drafts(folder: Path, file: str = "*") -> None:
    """Remove the drafts in a folder whose writers, processes of this machine, were killed.

    file: what they were to become, a pattern.
    """
    for path in folder.glob(f".{file}.*.partial"):
        draft = _DRAFT.fullmatch(path.name)
        if draft is not None and draft["host"] == _host() and not is_alive(int(draft["process"])):
            path.unlink(missing_ok=True)


def _host() -> str:
    return socket.gethostname().partition(".")[0]


def is_alive(process: int) -> bool:
    """Whether a process of this machine runs."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    return True
