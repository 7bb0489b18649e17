"""Which server a command evaluates, and how it is reached: `configs/server.yaml`."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Self
from urllib.parse import urlsplit

from mme_vla.config.sections import PathText, Positive, PositiveInt, Secret, read_section
from mme_vla.errors import require

Subgoals = Literal["simple", "grounded"]


@dataclass(frozen=True)
class ConnectionSettings:
    """The section `connection`; the keys and their meaning are those of `configs/server.yaml`."""

    name: PathText | None = None
    checkpoint: PathText | None = None
    api_key: Secret = field(default=None, repr=False)
    timeout_s: Positive = 600
    open_s: Positive = 60
    episodes: PositiveInt | None = None
    subgoal: Subgoals | None = None
    keys: Mapping[str, str] | None = None

    def __post_init__(self) -> None:
        key = self.api_key or ""
        require(
            key.isascii() and key.isprintable(),
            "connection.api_key (MME_VLA_SERVER_KEY) holds a line break or another character that"
            " no header takes.",
        )


@dataclass(frozen=True)
class ServerChoice:
    """A policy server. server: its address. protocol: of its messages."""

    server: str
    protocol: Literal["auto", "mme_vla", "robomme", "openpi", "challenge", "harness"] = "auto"
    connection: ConnectionSettings = ConnectionSettings()

    def __post_init__(self) -> None:
        # Messages, logs, receipts and cards name the address; this message does not.
        require(
            not set("@?#") & set(self.server),
            "server=… holds a user, a password or a query, which records would name: write"
            " scheme://host:port/path alone, and set MME_VLA_SERVER_KEY to the key.",
        )
        require(
            _is_address(self.server),
            f"server={self.server!r}: write ws://host:port, or http://host:port for the challenge's"
            " HTTP.",
        )
        require(
            not self.is_http or self.protocol in ("auto", "challenge"),
            f"protocol={self.protocol} has websockets alone: write server=ws://…",
        )

    @property
    def is_http(self) -> bool:
        return self.server.startswith("http")

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self | None:
        """Read the keys of a command; None where it names no server."""
        if config.get("server") is None:
            return None
        return read_section(cls, config, others=True)


def _is_address(text: str) -> bool:
    if text.partition("://")[0] not in ("ws", "wss", "http", "https"):
        return False
    try:
        address = urlsplit(text)
        return bool(address.hostname) and address.port != 0
    except ValueError:  # a port that is no number
        return False
