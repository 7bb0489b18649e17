"""One client: its episode, and what its requests do to it. Dropping the session frees all the
client's memory.
"""

import asyncio
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mme_vla.embodiment.robomme import benchmark_action
from mme_vla.errors import UserError, require
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.serving.codec import unpack
from mme_vla.serving.engine import Engine
from mme_vla.serving.requests import AddBuffer, Infer, Request, Reset, parse
from mme_vla.serving.settings import ServeSettings

SMALL = 2**16  # bytes decoded on the event loop; larger messages are decoded in a thread


class NoEpisodeError(UserError):
    """A request continues with an episode that is not here."""


async def read_request(engine: Engine, settings: ServeSettings, data: bytes | bytearray) -> Request:
    """Decode and check a message; a large one beside the event loop."""

    def read() -> Request:
        return parse(unpack(data), settings.limits.frames, engine.policy.embodiment)

    return read() if len(data) <= SMALL else await engine.decode(read)


def begins(request: Request) -> bool:
    """Whether a request begins an episode, whatever was before it."""
    return isinstance(request, Reset) or (isinstance(request, Infer) and request.first is True)


class Session:
    """The episode of one client.

    Requests of a session must come one after the other; `respond` is not to be called twice at the
    same time.
    """

    def __init__(self, engine: Engine, settings: ServeSettings) -> None:
        self._engine, self._settings = engine, settings
        self._begin()

    def _begin(self) -> None:
        self.episode = self._engine.policy.start_episode("", seed=self._settings.seed)
        self._exec_start = 0
        self._n_frames_at_action: int | None = None

    async def respond(self, request: Request, begun: float) -> dict[str, Any]:
        """Do what a request asks and return the answer, not yet packed.

        Args:
            begun: when the message was there whole (`time.perf_counter()`); the answer says how
                long it took.
        """
        if isinstance(request, Reset):
            self._begin()
            return {"reset_finished": True, "reset_time_ms": self._took("reset", begun)}
        if isinstance(request, AddBuffer):
            await self._add(request)
            return {
                "add_buffer_finished": True,
                "add_buffer_time_ms": self._took("add_buffer", begun),
            }
        actions = await self._infer(request)
        space = self._engine.policy.embodiment.action
        choices = (
            {"choices": [benchmark_action(space, row) for row in actions]} if space.choice else {}
        )
        return {"actions": actions, **choices, "infer_time_ms": self._took("infer", begun)}

    def _took(self, kind: str, begun: float) -> float:
        seconds = time.perf_counter() - begun
        self._engine.stats.took(kind, seconds)
        return seconds * 1e3

    async def _add(self, request: AddBuffer) -> None:
        if request.exec_start > 0:
            self._exec_start = request.exec_start
        self._check_capacity(len(request.frames))
        await self._engine.run(
            self._add_frames(request.frames, request.states), self._pieces(request.frames)
        )

    async def _infer(self, request: Infer) -> np.ndarray:
        policy = self._engine.policy
        reads_actions = policy.require_processor().prompt_spec.past_actions > 0
        if request.first:
            # a client that repeats its first request means the same episode, not a longer one
            self._begin()
        elif request.first is not None and self.episode.n_observed_frames == 0:
            raise NoEpisodeError(
                "is_first_step is false but this episode has no frame here: its first request must"
                " come first. Was the server restarted, or the connection lost? Reset and begin the"
                " episode again."
            )
        if (
            request.frames is None
            and self.episode.n_observed_frames == 0
            and policy.memory is not None
        ):
            raise UserError(
                "This policy remembers past frames: send them with add_buffer, the current one"
                " included."
            )
        if request.frames is None and request.observed is not None:
            self._check_capacity(1)
        if request.frames is not None:
            self._check_capacity(len(request.frames))
            if request.first:
                self._exec_start = len(request.frames) - 1
        elif reads_actions and self._n_frames_at_action == self.episode.n_observed_frames:
            raise UserError(
                "This policy reads which actions were executed, one a frame: send the frames since"
                " the last chunk with add_buffer before the observation."
            )
        episode = self.episode
        episode.goal, episode.subgoal = request.goal, self._subgoal(request)
        episode.options = request.options or episode.options
        await self._engine.run(self._observe(request), self._pieces(request.frames or ()))
        chunk = await self._engine.act(episode)
        if not np.isfinite(chunk).all():
            raise RuntimeError("the policy's answer is not finite")
        self._n_frames_at_action = episode.n_observed_frames
        # A challenge client executes all it is given; an MME-VLA client cuts the chunk itself.
        return (
            chunk if request.frames is None else chunk[: self._settings.executed(policy.embodiment)]
        )

    def _observe(self, request: Infer) -> Iterator[None]:
        if request.observed is not None and request.states is not None:
            yield from self._watch(request.observed, request.states)
        else:
            if request.frames is not None:
                yield from self._add_frames(request.frames, request.states)
            self.episode.set_view(request.images, request.state)
        _ = (
            self.episode.prompt
        )  # a goal that cannot be read fails here, and not in a batch with others

    def _add_frames(
        self, frames: Sequence[np.ndarray], states: np.ndarray | None
    ) -> Iterator[None]:
        """Take frames into memory, pausing after every `encode_chunk` frames that have to be
        encoded.
        """
        episode, piece = self.episode, self._piece
        for start in range(0, len(frames), piece):
            if start:
                yield
            taken = np.stack(frames[start : start + piece])
            demo = episode.n_observed_frames + np.arange(len(taken)) < self._exec_start
            proprio = None if states is None else states[start : start + piece]
            episode.add_frames(taken, demo, states=proprio)

    def _watch(self, frames: Mapping[str, np.ndarray], states: np.ndarray) -> Iterator[None]:
        """Take frames with what all cameras delivered, for a policy that reads more than images."""
        episode, piece = self.episode, self._piece
        for start in range(0, len(states), piece):
            if start:
                yield
            part = slice(start, start + piece)
            demo = episode.n_observed_frames + np.arange(len(states[part])) < self._exec_start
            episode.observe(
                {name: values[part] for name, values in frames.items()}, states[part], demo
            )

    @property
    def _piece(self) -> int:
        """Frames to a piece; of some memories most frames are never encoded."""
        memory = self._engine.policy.memory
        return self._settings.encode_chunk * (1 if memory is None else memory.storage.keep_every)

    def _pieces(self, frames: Sequence[np.ndarray]) -> int:
        return max(1, -(-len(frames) // self._piece))

    def _check_capacity(self, count: int) -> None:
        total, most = self.episode.n_observed_frames + count, self._settings.limits.frames
        require(
            total <= most,
            f"An episode of {total} frames: this server remembers at most {most} (limits.frames)."
            " Reset between episodes.",
        )

    def _subgoal(self, request: Infer) -> str | None:
        """The subgoal this policy was trained to read, of those the request brings."""
        kind = subgoal_kind(self._engine.policy)
        if kind is not None:
            return request.subgoals.get(kind)
        subgoals = list(request.subgoals.values())
        return subgoals[0] if len(subgoals) == 1 else None


Name = tuple[str, str]  # address and X-Session
LOST = (
    "There is no episode of yours here: it was never begun, an error ended it, it was silent for"
    " too long, it gave its place to another on a full server, or the server was restarted. Reset"
    " and begin the episode again."
)


class BusyError(Exception):
    """Every session is at work."""


@dataclass(eq=False)
class SessionEntry:
    """A session. requests: those it works on or that wait for their turn; `used`: end of the last
    one.
    """

    session: Session
    requests: int = 0
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    used: float = field(default_factory=time.monotonic)


class HttpSessions:
    """The sessions of a server, at most `limits.connections` of them."""

    def __init__(self, engine: Engine, settings: ServeSettings) -> None:
        self._engine, self._settings = engine, settings
        self.entries: dict[Name, SessionEntry] = {}

    async def respond(self, name: Name, request: Request, begun: float) -> dict[str, Any]:
        """Answer a request of a session, after those of the same session that came before."""
        entry = self.find(name, request)
        entry.requests += 1
        try:
            async with entry.lock:
                if self.entries.get(name) is not entry and not begins(request):
                    raise NoEpisodeError(LOST)  # a request before this one failed
                return await entry.session.respond(request, begun)
        except Exception:
            self.drop(name, entry)
            raise
        finally:
            entry.requests -= 1
            entry.used = time.monotonic()

    def find(self, name: Name, request: Request) -> SessionEntry:
        """The session of that name; a new one takes the place of the longest silent where there is
        no other.
        """
        if name in self.entries:
            return self.entries[name]
        if not begins(request):
            raise NoEpisodeError(LOST)
        if len(self.entries) >= self._settings.limits.connections:
            silent = [known for known, entry in self.entries.items() if not entry.requests]
            if not silent:
                raise BusyError(f"{len(self.entries)} sessions are at work, as many as fit here.")
            del self.entries[min(silent, key=lambda known: self.entries[known].used)]
            self._engine.stats.count("let_go")
        self.entries[name] = SessionEntry(Session(self._engine, self._settings))
        return self.entries[name]

    def drop(self, name: Name, entry: SessionEntry | None = None) -> None:
        """End a session; where `entry` is given, only if the name still means that one."""
        if entry is None or self.entries.get(name) is entry:
            self.entries.pop(name, None)

    async def forget_silent(self) -> None:
        """Free the memory of sessions that have been silent for `limits.idle_s`."""
        idle = self._settings.limits.idle_s
        while True:
            await asyncio.sleep(min(15, idle / 4))
            oldest = time.monotonic() - idle
            for name, entry in list(self.entries.items()):
                if entry.used < oldest and not entry.requests:
                    del self.entries[name]


def error_text(error: Exception) -> str:
    """What a client is told of an error: a mistake of its own in full, anything else without its
    traceback.
    """
    if isinstance(error, UserError | BusyError):
        return str(error)
    return f"The server failed on this request ({type(error).__name__}: {str(error)[:200]})."
