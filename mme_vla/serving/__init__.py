"""Policy servers and their clients (the extra `serve`).

>>> from mme_vla.serving import Client
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mme_vla.serving.client import Client
    from mme_vla.serving.codec import pack, unpack
    from mme_vla.serving.remote.policy import RemotePolicy
    from mme_vla.serving.remote.settings import ServerChoice
    from mme_vla.serving.server import PolicyServer
    from mme_vla.serving.settings import Limits, ServeSettings

# Loaded on first use: a client needs no network library of the server, and neither is needed to
# import the package.
_HOME = {
    "Client": "client",
    "pack": "codec",
    "unpack": "codec",
    "PolicyServer": "server",
    "RemotePolicy": "remote.policy",
    "ServerChoice": "remote.settings",
    "Limits": "settings",
    "ServeSettings": "settings",
}

__all__ = [
    "Client",
    "Limits",
    "PolicyServer",
    "RemotePolicy",
    "ServeSettings",
    "ServerChoice",
    "pack",
    "unpack",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value
