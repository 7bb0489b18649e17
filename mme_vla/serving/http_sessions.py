"""Episodes of HTTP clients, which have no connection to tie them to.

The rule: one session per client address, told apart further by the header `X-Session` where several clients share an
address. A session begins with a reset or a first step, and ends with an error, with silence, or when a new one needs
its place. A request that would go on with an episode that is not here is told so, and does not begin another.
"""

import asyncio
import time
from dataclasses import dataclass, field
from typing import Any

from mme_vla.errors import UserError
from mme_vla.serving.engine import Engine
from mme_vla.serving.requests import Request
from mme_vla.serving.session import NoEpisodeError, Session, begins
from mme_vla.serving.settings import ServeSettings

Name = tuple[str, str]  # address and X-Session
LOST = (
    "There is no episode of yours here: it was never begun, an error ended it, it was silent for too long, it gave its "
    "place to another on a full server, or the server was restarted. Reset and begin the episode again."
)


class BusyError(Exception):
    """Every session is at work."""


@dataclass(eq=False)
class Kept:
    """A session. requests: those it works on or that wait for their turn; `used`: end of the last one."""

    session: Session
    requests: int = 0
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)
    used: float = field(default_factory=time.monotonic)


class HttpSessions:
    """The sessions of a server, at most `limits.connections` of them."""

    def __init__(self, engine: Engine, settings: ServeSettings) -> None:
        self._engine, self._settings = engine, settings
        self.kept: dict[Name, Kept] = {}

    async def answer(self, name: Name, request: Request, begun: float) -> dict[str, Any]:
        """Answer a request of a session, after those of the same session that came before.

        Raises:
            NoEpisodeError: the request goes on with an episode that is not here.
            BusyError: a new session, and no place for it.
            UserError: the request does not fit the episode, which ends with it, as it does with any other error.
        """
        kept = self.find(name, request)
        kept.requests += 1
        try:
            async with kept.turn:
                if self.kept.get(name) is not kept and not begins(request):
                    raise NoEpisodeError(LOST)  # a request before this one failed
                return await kept.session.answer(request, begun)
        except Exception:
            self.drop(name, kept)
            raise
        finally:
            kept.requests -= 1
            kept.used = time.monotonic()

    def find(self, name: Name, request: Request) -> Kept:
        """The session of that name; a new one takes the place of the longest silent where there is no other."""
        if name in self.kept:
            return self.kept[name]
        if not begins(request):
            raise NoEpisodeError(LOST)
        if len(self.kept) >= self._settings.limits.connections:
            silent = [known for known, kept in self.kept.items() if not kept.requests]
            if not silent:
                raise BusyError(f"{len(self.kept)} sessions are at work, as many as fit here.")
            del self.kept[min(silent, key=lambda known: self.kept[known].used)]
            self._engine.stats.count("let_go")
        self.kept[name] = Kept(Session(self._engine, self._settings))
        return self.kept[name]

    def drop(self, name: Name, kept: Kept | None = None) -> None:
        """End a session; where `kept` is given, only if the name still means that one."""
        if kept is None or self.kept.get(name) is kept:
            self.kept.pop(name, None)

    async def forget_silent(self) -> None:
        """Free the memory of sessions that have been silent for `limits.idle_s`."""
        idle = self._settings.limits.idle_s
        while True:
            await asyncio.sleep(min(15, idle / 4))
            oldest = time.monotonic() - idle
            for name, kept in list(self.kept.items()):
                if kept.used < oldest and not kept.requests:
                    del self.kept[name]


def said(error: Exception) -> str:
    """What a client is told of an error: a mistake of its own in full, anything else without its traceback."""
    if isinstance(error, UserError | BusyError):
        return str(error)
    return f"The server failed on this request ({type(error).__name__}: {str(error)[:200]})."
