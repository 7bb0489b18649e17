"""`Session`: the episode of one client, and what its requests do to it.

Dropping the session frees all the client's memory. `HttpSessions` holds those of clients whose
connection does not identify an episode.
"""

import asyncio
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mme_vla.embodiment.robomme import benchmark_action
from mme_vla.errors import UserError, require
from mme_vla.policy.base import frames_a_piece
from mme_vla.processing.normalise import check_reach
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.serving.engine import Engine
from mme_vla.serving.requests import AddBuffer, Infer, Request, Reset
from mme_vla.serving.settings import ServeSettings


class NoEpisodeError(UserError):
    """A request continues with an episode that is not here."""


class Session:
    """The episode of one client.

    Requests of a session must come one after the other; `respond` is not to be called twice at the
    same time.

    intact: whether the episode can go on. It can after a request that was carried out, or refused
        before it changed anything, and not after one that failed half way.
    """

    def __init__(self, engine: Engine, settings: ServeSettings) -> None:
        self._engine = engine
        self._settings = settings
        self._seed = settings.seed
        self._piece = frames_a_piece(engine.policy, settings.encode_chunk)
        self._begin()

    def _begin(self) -> None:
        self.intact = False  # where memory runs out, the former episode does not go on
        self.episode = self._engine.policy.start_episode("", seed=self._seed)
        self._exec_start = 0
        self._n_frames_at_action: int | None = None
        self._sizes: dict[tuple[str, str], tuple[int, ...]] = {}  # by kind of message and camera
        self.intact = True

    async def respond(self, request: Request, begun: float) -> dict[str, Any]:
        """Do what a request asks and return the reply as the protocol has it, not yet packed.

        Args:
            begun: when the message was there whole (`time.perf_counter()`); the reply says how
                long it took.

        Raises:
            UserError: the request is refused. `intact` says whether the episode can go on.
        """
        reply: dict[str, Any] = {}
        if isinstance(request, Reset):
            kind = "reset"
            self._seed = self._settings.seed if request.seed is None else request.seed
            self._begin()
            reply["reset_finished"] = True
        elif isinstance(request, AddBuffer):
            kind = "add_buffer"
            await self._add_buffer(request)
            reply["add_buffer_finished"] = True
        else:
            kind = "infer"
            reply["actions"] = await self._infer(request)
            space = self._engine.policy.embodiment.action
            if space.choice:
                reply["choices"] = [benchmark_action(space, row) for row in reply["actions"]]
        self.intact = True
        seconds = time.perf_counter() - begun
        self._engine.stats.took(kind, seconds)
        reply[f"{kind}_time_ms"] = seconds * 1e3
        return reply

    async def _add_buffer(self, request: AddBuffer) -> None:
        count = len(request.frames)
        self._check_capacity(count)
        robot = self._engine.policy.embodiment
        self._check_states(request.states)
        self._check_sizes("add_buffer", {robot.memory_camera: request.frames})
        self.intact = False
        if request.exec_start > 0:
            self._exec_start = request.exec_start

        def take(part: slice, is_demo: np.ndarray) -> None:
            frames = np.stack(request.frames[part])
            self.episode.add_frames(frames, is_demo, states=request.states[part])

        await self._engine.run(self._in_pieces(count, take), self._n_pieces(count))

    async def _infer(self, request: Infer) -> np.ndarray:
        count = len(request.states)
        self._check_states(request.states)  # before a first request ends the episode that was
        # A client that repeats its first request means the same episode, not a longer one.
        if request.first:
            self._begin()
            self._exec_start = count - 1 if request.exec_start is None else request.exec_start
        self._check_course(request)
        if request.stored:
            self._check_capacity(count)
        cameras = self._engine.policy.embodiment.camera_names
        self._check_sizes("observation", {name: request.views[name] for name in cameras})
        self.intact = False

        episode = self.episode
        episode.goal = request.goal
        episode.subgoal = self._subgoal(request)
        if request.options:
            episode.options = request.options
        await self._engine.run(self._observe(request), self._n_pieces(count))
        chunk = await self._engine.act(episode)
        if not np.isfinite(chunk).all():
            raise RuntimeError("the policy's answer is not finite")
        self._n_frames_at_action = episode.n_observed_frames
        if request.first is None:  # an MME-VLA client cuts the chunk itself
            return chunk
        return chunk[: self._settings.executed(self._engine.policy.embodiment)]

    def _check_course(self, request: Infer) -> None:
        """Make sure that the episode has the frames this request continues from.

        Raises:
            NoEpisodeError: the episode that the client means is not here.
            UserError: frames have to be sent before.
        """
        policy = self._engine.policy
        n_observed = self.episode.n_observed_frames
        if request.first is False and n_observed == 0:
            raise NoEpisodeError(
                "is_first_step is false but this episode has no frame here: its first request must"
                " come first. Was the server restarted, or the connection lost? Reset and begin the"
                " episode again."
            )
        if request.stored:
            return
        processor = policy.require_processor()
        window = processor.samples.window
        # An observation comes once a chunk, and the frames between two are not in it.
        require(
            window == 1 or not processor.samples.consecutive,
            f"This policy reads the last {window} frames of every camera, and an"
            " observation is one frame: send all frames since the last request in lists"
            " (<camera>_rgb_list).",
        )
        if policy.memory is not None:
            require(
                n_observed,
                "This policy remembers past frames: send them with add_buffer, the current one"
                " included.",
            )
            require(
                self._exec_start < n_observed,
                f"exec_start_idx={self._exec_start}: it is one of the {n_observed} frames of the"
                " episode so far, and the current frame would be one of the video. Reset and begin"
                " the episode again.",
            )
        reads_actions = processor.prompt_spec.past_actions > 0
        if reads_actions and self._n_frames_at_action == n_observed:
            raise UserError(
                "This policy reads which actions were executed, one a frame: send the frames since"
                " the last chunk with add_buffer before the observation."
            )

    def _observe(self, request: Infer) -> Iterator[None]:
        if request.stored:
            # Frames before `first_led` were led to by no action that the client names.
            executed = request.executed
            count = len(request.states)
            first_led = count if executed is None else count - len(executed)

            def take(part: slice, is_demo: np.ndarray) -> None:
                middle = min(max(part.start, first_led), part.stop)
                for piece in (slice(part.start, middle), slice(middle, part.stop)):
                    if piece.start == piece.stop:
                        continue
                    views = {name: np.stack(view[piece]) for name, view in request.views.items()}
                    actions = None
                    if executed is not None and piece.start >= first_led:
                        actions = executed[piece.start - first_led : piece.stop - first_led]
                    demo = is_demo[piece.start - part.start : piece.stop - part.start]
                    self.episode.observe(views, request.states[piece], demo, actions)

            yield from self._in_pieces(len(request.states), take)
        else:
            views = {name: view[-1] for name, view in request.views.items()}
            self.episode.set_view(views, request.states[-1])
        # A goal that cannot be read fails here, and not in a batch with others.
        _ = self.episode.prompt

    def _in_pieces(self, count: int, take: Callable[[slice, np.ndarray], None]) -> Iterator[None]:
        """Take frames, pausing after every `encode_chunk` of those that have to be encoded.

        take: is given the piece of the request's frames, and which of them are of the conditioning
            video.
        """
        for start in range(0, count, self._piece):
            if start:
                yield
            part = slice(start, min(start + self._piece, count))
            numbers = self.episode.n_observed_frames + np.arange(part.stop - start)
            take(part, numbers < self._exec_start)

    def _n_pieces(self, count: int) -> int:
        return max(1, -(-count // self._piece))

    def _check_capacity(self, count: int) -> None:
        total = self.episode.n_observed_frames + count
        most = self._settings.limits.frames
        if total > most:
            raise UserError(
                f"An episode of {total} frames: this server remembers at most {most}"
                " (limits.frames). Reset between episodes."
            )

    def _check_states(self, states: np.ndarray) -> None:
        stats = self._engine.policy.require_processor().require_stats()
        check_reach(states, stats.state, "a state")

    def _check_sizes(self, kind: str, views: Mapping[str, Sequence[np.ndarray]]) -> None:
        """Make sure that a camera's images have the size that they had when the episode began.

        kind: of the message. Clients may scale the images of one kind and not those of the other.
        """
        sizes = {(kind, name): view[0].shape[:2] for name, view in views.items() if len(view)}
        for key, size in sizes.items():
            before = self._sizes.get(key, size)
            if size != before:
                raise UserError(
                    f"The images of camera {key[1]!r} have {list(size)} pixels (height, width), and"
                    f" had {list(before)} before in this episode: send one size."
                )
        self._sizes |= sizes

    def _subgoal(self, request: Infer) -> str | None:
        """The subgoal this policy was trained to read, of those the request brings."""
        kind = subgoal_kind(self._engine.policy)
        if kind is not None:
            return request.subgoals.get(kind)
        if len(request.subgoals) != 1:
            return None
        (subgoal,) = request.subgoals.values()
        return subgoal


Name = tuple[str, str]  # address and X-Session
LOST = (
    "There is no episode of yours here: it was never begun, an error ended it, a reply was not"
    " waited for, it was silent for too long, it gave its place to another on a full server, or the"
    " server was restarted. Reset and begin the episode again."
)


@dataclass(eq=False)
class SessionEntry:
    """A session of an HTTP client.

    requests: those it works on or that wait for their turn.
    used: end of the last one (`time.monotonic()`).
    """

    session: Session
    requests: int = 0
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    used: float = field(default_factory=time.monotonic)


class HttpSessions:
    """The sessions of HTTP clients, at most `limits.connections` of them."""

    def __init__(self, engine: Engine, settings: ServeSettings) -> None:
        self._engine = engine
        self._settings = settings
        self.entries: dict[Name, SessionEntry] = {}

    def silent(self) -> list[Name]:
        """Sessions between two requests, the longest silent one first."""
        names = [name for name, entry in self.entries.items() if not entry.requests]
        return sorted(names, key=lambda name: self.entries[name].used)

    async def respond(
        self, name: Name, request: Request, begun: float, has_left: Callable[[], bool]
    ) -> dict[str, Any]:
        """Reply to a request of a session, after those of the same session that came before.

        A new session replaces the longest silent one where there is no other place. There is a
        silent one: the requests at work, this one included, are at most `limits.connections`.

        Args:
            has_left: whether the client does not wait for the reply any more. It cannot know
                whether its frames were taken and may send them again: its episode ends.

        Raises:
            NoEpisodeError: the episode has ended, or never began.
        """
        begins = isinstance(request, Reset) or (
            isinstance(request, Infer) and request.first is True
        )
        if name not in self.entries:
            require(begins, LOST, NoEpisodeError)
            if len(self.entries) >= self._settings.limits.connections:
                del self.entries[self.silent()[0]]
                self._engine.stats.counts["let_go"] += 1
            self.entries[name] = SessionEntry(Session(self._engine, self._settings))
        entry = self.entries[name]
        entry.requests += 1
        try:
            async with entry.lock:
                # A request before this one may have failed and ended the episode.
                require(begins or entry.session.intact, LOST, NoEpisodeError)
                reply = await entry.session.respond(request, begun)
                if not begins and has_left():
                    entry.session.intact = False
                return reply
        finally:
            entry.requests -= 1
            entry.used = time.monotonic()
            if not entry.session.intact and not entry.requests:
                self.entries.pop(name, None)

    def forget_silent(self) -> None:
        """Free the memory of sessions that have been silent for `limits.idle_s`."""
        oldest = time.monotonic() - self._settings.limits.idle_s
        for name in self.silent():
            if self.entries[name].used < oldest:
                del self.entries[name]
