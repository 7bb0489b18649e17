"""The one exception a command shows without a traceback, and the words for a misspelt name."""

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

CONSTRAINTS = Path(__file__).resolve().parents[1] / "constraints.txt"
"""The versions known to work together, in a clone."""
LONG = 20
"""Names that a message lists beside a good guess, at most, where a command lists them all."""


class UserError(ValueError):
    """Something the user gave cannot work: the message names the value, what was expected, and what
    to do.

    Values may come from untrusted files: the middle of a message that is longer than
    `LONGEST` characters is left out.
    """

    LONGEST = 2000

    def __init__(self, message: str) -> None:
        if len(message) > self.LONGEST:
            message = f"{message[: self.LONGEST // 2]} … {message[-self.LONGEST // 4 :]}"
        super().__init__(message)


class SceneError(RuntimeError):
    """A scene that cannot be laid out from its seed: an object found no place."""


def set_place(error: BaseException, place: str) -> None:
    """Store where in a plugin's code an error arose: its kind, file and line. The text is pickled
    with the error.
    """
    vars(error).update(plugin_place=place)


def place_of(error: BaseException | None) -> str | None:
    """What `set_place` stored; None of errors that arose elsewhere."""
    return getattr(error, "plugin_place", None)


def text_of(error: BaseException) -> str:
    """The message of an error, with its place if it is a plugin's."""
    place = place_of(error)
    if place is None:
        return str(error)
    return f"{error} ({place})"


def require(holds: object, message: str, error: type[Exception] = UserError) -> None:
    """Raise an error with this message unless something holds.

    The message is made in either case: for checks in a hot loop, or of a value it cannot name,
    write `if` and `raise`.
    """
    if not holds:
        raise error(message)


ERROR = "Error: "
"""What a command prints before the message of an error."""


def check_choice(key: str, value: object, options: Iterable[str]) -> None:
    """Make sure that a value is one of the options of its key."""
    known = list(options)
    if not (isinstance(value, str) and value in known):
        raise UserError(f"{key}={brief(value)}. {did_you_mean(brief(value), known)}")


def check_sizes(section: str, **sizes: int) -> None:
    """Make sure that numbers of a section are whole and at least 1."""
    for key, value in sizes.items():
        is_integer = isinstance(value, int) and not isinstance(value, bool)
        require(
            is_integer and value >= 1,
            f"{section}.{key}={brief(value)} must be at least 1, a whole number.",
        )


LARGEST = 2**16
"""Of any size of a robot or a processor: what is larger is a damaged file, and would
take memory.
"""


def check_integer(key: str, value: object, most: int = LARGEST) -> int:
    """The value of a key, a whole number from 1 to `most`."""
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= most:
        raise UserError(f"{key} must be a positive whole number to {most}, got {brief(value)}.")
    return value


def check_multiple(section: str, name: str, value: int, of: str, unit: int) -> None:
    """Make sure that a size is a multiple of another one."""
    require(value % unit == 0, f"{section}{name}={value} must be a multiple of {of}={unit}.")


def check_known(kind: str, value: object, known: Iterable[str]) -> None:
    """Make sure that a name is one of those that exist, such as the name of a task."""
    if value not in (names := list(known)):
        raise UserError(f"Unknown {kind} {value!r}. {did_you_mean(str(value), names)}")


def did_you_mean(name: str, options: Iterable[str], listed_by: str = "") -> str:
    """Return a sentence that lists `options`, with the ones nearest to `name` first in line.

    listed_by: the command that lists them; it stands for a list of more than `LONG` where some are
    near.

    >>> did_you_mean("tokendrp", ["framesamp", "tokendrop"])
    "Did you mean 'tokendrop'? Known: framesamp, tokendrop."
    """
    known = sorted(options)
    # the time it takes grows with the square
    near = get_close_matches(name[:200], known, n=3, cutoff=0.6)
    hint = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
    if near and listed_by and len(known) > LONG:
        return f"{hint}`{listed_by}` lists all {len(known)}."
    return f"{hint}Known: {', '.join(known) or 'none'}."


def missing_extra(what: str, extra: str, pip: tuple[str, str] | None = None) -> UserError:
    """The error to raise where the packages of an extra are not installed: what needs them, and
    what installs them.

    Only a clone has `constraints.txt` beside the package. `--inexact` keeps the extras that are
    there already; a plain `uv sync` would take them away. `pip` is for an extra with a package that
    pip and `uv pip` refuse: the extra to install in its place, and what follows on the command.
    """
    of_pip, further = pip or (extra, "")
    if not CONSTRAINTS.is_file():
        package = f"'mme-vla[{of_pip}]'"
        with_uv = "" if pip else f" (with uv: uv pip install {package})"
        return UserError(
            f"{what} needs the extra `{extra}`. With pip: pip install {package}{further}{with_uv}."
        )
    with_uv = f"uv sync --inexact --extra {extra}"
    with_pip = f"pip install -c constraints.txt -e '.[{of_pip}]'{further}"
    return UserError(
        f"{what} needs the extra `{extra}`. In the clone: {with_uv} (without uv: {with_pip})."
    )


def brief(value: object, most: int = 80, quote: bool = True) -> str:
    """A value as it is in a message: its repr, cut in the middle where it is longer than `most`
    characters.

    >>> brief("x" * 1000, 9)
    "'xxx…xxx'"
    """
    try:
        text = repr(value) if quote or not isinstance(value, str) else value
    except (
        ValueError,
        RecursionError,
    ):  # an integer of thousands of digits, a value nested too deeply
        text = f"a value of type {type(value).__name__}"
    half = (most - 1) // 2
    return text if len(text) <= most else f"{text[:half]}…{text[-half:]}"


def counted(number: int, noun: str) -> str:
    """A number of things as text: `1 run`, `1,200 runs`."""
    if number == 1:
        return f"1 {noun}"
    return f"{number:,} {noun}s"


def printable(text: str) -> str:
    r"""Text for a terminal: escape sequences and other characters that cannot be seen, spelled out.
    Lines stay lines.

    >>> print(printable("\x1b[2J"))
    \x1b[2J
    """
    return "".join(
        letter
        if letter.isprintable() or letter in "\n\N{NO-BREAK SPACE}"
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


def listed(names: Iterable[object], most: int = 12) -> str:
    """Names as one list of a message, the first `most` of them and how many more there are.

    >>> listed(["a", "b", "c"], 2)
    'a, b and 1 more'
    """
    every = [brief(str(name), 120, quote=False) for name in names]
    remaining = len(every) - most
    return ", ".join(every[:most]) + (f" and {remaining:,} more" if remaining > 0 else "")
