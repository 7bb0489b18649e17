"""Addresses to listen on, for the policy server and the page of `mme_vla.play`."""

import ipaddress
import socket

from mme_vla.errors import UserError


def is_local(host: str) -> bool:
    """Whether a host name or address is this machine's own loopback."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def listen(host: str, port: int) -> socket.socket:
    """A socket bound to this address.

    Raises:
        UserError: no such address, or the port is taken or not allowed.
    """
    if isinstance(port, bool) or not isinstance(port, int) or not 0 <= port < 2**16:
        raise UserError(f"port={port!r} is no port; choose 0 (any free one) to 65535.")
    bound = None
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        bound = socket.socket(family, kind, protocol)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        bound.listen()
    except OSError as error:
        if bound is not None:
            bound.close()
        raise UserError(f"Cannot listen at {host}, port {port} ({error.strerror}); choose others.") from None
    return bound
