"""A folder of replies: the same question then needs no key, no network and no package."""

import logging
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError
from mme_vla.utils import read_json, verified, with_checksum, write_json

log = logging.getLogger(__name__)
MOST_TOKENS = 2**40
"""Of one reply. A larger number is no count of tokens."""


@dataclass(frozen=True)
class Reply:
    """A reply of a model and the tokens it took; thoughts count as output."""

    text: str
    input_tokens: int
    output_tokens: int


class ReplyCache:
    """Replies by the digest of their question. Several processes may share the folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, digest: str) -> Path:
        return self.folder / digest[:2] / f"{digest}.json"

    def read(self, digest: str) -> Reply | None:
        """Return a stored reply; None where there is none, or its file is damaged."""
        path = self.path(digest)
        if not path.exists() and not path.is_symlink():
            return None
        try:
            stored = verified(read_json(path, "a stored reply"), str(path))
            # A model's text may hold half characters, which no section of a configuration may.
            text = stored.get("text")
            counts: list[Any] = [stored.get(key) for key in ("input_tokens", "output_tokens")]
            are_counts = all(type(count) is int and 0 <= count < MOST_TOKENS for count in counts)
            if not isinstance(text, str) or not are_counts:
                raise UserError(f"{path} lacks a text and two numbers of tokens.")
        except UserError as error:
            log.warning("%s The question is asked again.", error)
            return None
        return Reply(text, *counts)

    def write(self, digest: str, reply: Reply) -> None:
        path = self.path(digest)
        try:
            write_json(path, with_checksum(asdict(reply)), indent=None)
        except OSError as error:  # such as a full disk: the reply is used all the same
            log.warning("%s cannot be written: %s", path, error.strerror)
