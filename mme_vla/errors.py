"""The one exception a command shows without a traceback, and the words for a misspelt name."""

from collections.abc import Iterable
from difflib import get_close_matches


class UserError(ValueError):
    """Something the user gave cannot work: the message names the value, what was expected, and what to do."""


def did_you_mean(name: str, options: Iterable[str]) -> str:
    """Return a sentence that lists `options`, with the ones nearest to `name` first in line.

    >>> did_you_mean("tokendrp", ["framesamp", "tokendrop"])
    "Did you mean 'tokendrop'? Known: framesamp, tokendrop."
    """
    known = sorted(options)
    near = get_close_matches(name, known, n=3, cutoff=0.6)
    hint = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
    return f"{hint}Known: {', '.join(known) or 'none'}."
