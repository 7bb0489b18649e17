"""The one exception a command shows without a traceback, and the words for a misspelt name."""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(ValueError):
    """Something the user gave cannot work: the message names the value, what was expected, and what to do."""


def require(condition: object, message: str) -> None:
    """Raise a `UserError` with this message unless the condition holds."""
    if not condition:
        raise UserError(message)


def check_known(kind: str, value: object, known: Iterable[str]) -> None:
    """Make sure that a name is one of those that exist, such as the name of a task."""
    if value not in (names := list(known)):
        raise UserError(f"Unknown {kind} {value!r}. {did_you_mean(str(value), names)}")


def did_you_mean(name: str, options: Iterable[str]) -> str:
    """Return a sentence that lists `options`, with the ones nearest to `name` first in line.

    >>> did_you_mean("tokendrp", ["framesamp", "tokendrop"])
    "Did you mean 'tokendrop'? Known: framesamp, tokendrop."
    """
    known = sorted(options)
    near = get_close_matches(name[:200], known, n=3, cutoff=0.6)  # the time it takes grows with the square
    hint = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
    return f"{hint}Known: {', '.join(known) or 'none'}."


def missing_extra(what: str, extra: str) -> UserError:
    """The error to raise where the packages of an extra are not installed: what needs them, and what installs them.

    `--inexact` keeps the extras that are there already; a plain `uv sync` would take them away.
    """
    with_uv, with_pip = f"uv sync --inexact --extra {extra}", f"pip install -c constraints.txt -e '.[{extra}]'"
    return UserError(f"{what} needs the extra `{extra}`. In the clone: {with_uv} (without uv: {with_pip}).")


def brief(value: object, most: int = 80, quote: bool = True) -> str:
    """A value as it is in a message: its repr, cut in the middle where it is longer than `most` characters.

    >>> brief("x" * 1000, 9)
    "'xxx…xxx'"
    """
    try:
        text = repr(value) if quote or not isinstance(value, str) else value
    except (ValueError, RecursionError):  # an integer of thousands of digits, a value nested too deeply
        text = f"a value of type {type(value).__name__}"
    half = (most - 1) // 2
    return text if len(text) <= most else f"{text[:half]}…{text[-half:]}"


def printable(text: str) -> str:
    r"""Text for a terminal: escape sequences and other characters that cannot be seen, spelled out. Lines stay lines.

    >>> print(printable("\x1b[2J"))
    \x1b[2J
    """
    return "".join(
        letter if letter.isprintable() or letter in "\n\N{NO-BREAK SPACE}" else letter.encode("unicode_escape").decode()
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
