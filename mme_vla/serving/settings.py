"""Settings of a server, checked before it starts."""

import ipaddress
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, Self

from mme_vla.config.sections import Positive, PositiveInt, Range, Secret, read_section
from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, require


def is_local(host: str) -> bool:
    """Whether a host name or address is this machine's own loopback."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def listen(host: str, port: int) -> socket.socket:
    require(0 <= port < 2**16, f"port={port!r} is no port; choose 0 (any free one) to 65535.")
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        # Of `::`, IPv4 clients too.
        dualstack = family == socket.AF_INET6 and socket.has_dualstack_ipv6()
        return socket.create_server(address, family=family, dualstack_ipv6=dualstack)
    except OSError as error:
        reason, _, _ = str(error.strerror).partition(" (")  # which repeats the address
        raise UserError(
            f"Cannot listen at {host}, port {port} ({reason}); choose others."
        ) from None


@dataclass(frozen=True)
class Limits:
    """Limits of one client, in seconds unless the name says otherwise."""

    message_mib: Positive = 2048
    frames: PositiveInt = 4096
    connections: PositiveInt = 64
    send_s: Positive = 60
    receive_s: Positive = 120
    pong_s: Positive = 600
    idle_s: Positive = 3600
    stop_s: Positive = 30

    @property
    def message_bytes(self) -> int:
        return int(self.message_mib * 2**20)


@dataclass(frozen=True)
class ServeSettings:
    """How to serve; the keys and their meaning are those of configs/serve.yaml."""

    host: str = "127.0.0.1"
    port: Annotated[int, Range(0, 65535)] = 8001
    api_key: Secret = field(default=None, repr=False)
    require_key: bool = False
    action_space: (
        Literal["joint_angle", "ee_pose", "waypoint", "ee_delta", "multi_choice"] | None
    ) = None
    execute: PositiveInt | None = None
    flow_steps: PositiveInt | None = None
    seed: int = 42
    max_batch: PositiveInt = 16
    encode_chunk: PositiveInt = 32
    log_every_s: Positive = 60
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        key = self.api_key
        if key is not None and not (
            key.isascii() and key.isprintable() and key.strip() == key != ""
        ):
            raise UserError(
                "api_key must be plain ASCII text without blanks around it; null for no key."
            )
        require(
            not self.require_key or key is not None,
            "require_key=true, and there is no api_key: set the environment variable"
            " MME_VLA_API_KEY, or require_key=false to serve every client that reaches the port.",
        )

    @classmethod
    def from_dict(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration; keys of other purposes are ignored."""
        return read_section(cls, config, others=True)

    def executed(self, robot: Embodiment) -> int:
        """Actions of a chunk that a challenge client gets, and executes."""
        return min(self.execute or robot.action.execute, robot.action.horizon)

    def check_robot(self, robot: Embodiment, past_actions: int = 0) -> None:
        """Make sure that a policy for this robot, whose prompt reads so many past actions, can be
        served like this.
        """
        require(
            not past_actions or robot.action.frames is not None,
            "This policy reads which motions were executed, and the frames that a client sends do"
            f" not tell how many motions of {robot.name!r} they took: it cannot be served.",
        )
        require(
            self.action_space in (None, robot.action.answers),
            f"action_space={self.action_space}: this policy returns {robot.action.answers},"
            f" {robot.action.width} numbers an action, and nothing is converted. The client has to"
            " convert.",
        )
