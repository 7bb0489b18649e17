"""`RemotePolicy`: a policy that computes in a server of any known protocol.

Rollouts and probes drive it as any other policy. An episode collects what it observes. When it
acts, the frames since its last chunk go to the server over a connection of its own, those of a
batch at the same time. What goes wrong with one episode's connection or reply is that episode's
`failure`.
"""

import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from typing import Any, cast
from weakref import WeakSet

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.config.sections import read_section
from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.policy.base import Policy, PolicyInfo
from mme_vla.policy.episode import Episode, Failure
from mme_vla.policy.identity import PolicyIdentity
from mme_vla.processing.base import PolicyProcessor, PromptSpec
from mme_vla.processing.normalise import NormStats
from mme_vla.serving.remote.connections import Connection, open_patiently
from mme_vla.serving.remote.protocols import (
    LONGEST_CHUNK,
    PROTOCOLS,
    NewFrames,
    ServerMetadata,
    ServerProtocol,
    count_of,
    detect,
)
from mme_vla.serving.remote.settings import ServerChoice
from mme_vla.utils import safe_name

DECISIVE = ("identity", "robot", "horizon", "execute", "subgoal", "sample_steps")
"""What metadata of this library's server say of a policy, all of which its records depend on."""
LARGEST_ACTION = 1e4
"""Largest size of a number of an action: radians, metres and shares are far below."""
_LONGEST_METADATA = 4000  # characters of a server's metadata, in a receipt
_MS_KEYS = ("infer_ms", "infer_time_ms")
"""Where servers say how long they computed: openpi's in `server_timing`, RoboMME's beside the
actions.
"""


class RemoteProcessor(PolicyProcessor):
    """Leaves observations and actions as they are: the server prepares them for its network."""

    def __init__(self, robot: Embodiment, reads_subgoal: bool) -> None:
        self.embodiment = robot
        self._reads_subgoal = reads_subgoal

    def require_stats(self) -> NormStats:
        """Statistics that change no number; those of the network are the server's."""
        return NormStats.unit(self.embodiment.state.width, self.embodiment.action.width)

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """No images [v, 3, 0, 0]: the network that reads them is elsewhere."""
        return torch.zeros((len(views), 3, 0, 0), dtype=torch.uint8)

    @property
    def prompt_spec(self) -> PromptSpec:
        return PromptSpec(encoder="server", name="server", reads_subgoal=self._reads_subgoal)

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """The chunk itself: servers return absolute actions."""
        return chunk


class RemoteEpisode(Episode):
    """What is observed and not sent yet, and the connection of one episode."""

    policy: "RemotePolicy"

    def __init__(self, policy: "RemotePolicy", goal: str, seed: int = 0) -> None:
        super().__init__(policy, goal, seed)
        self._seed = seed
        self._new: list[tuple[Mapping[str, Any], np.ndarray, int, np.ndarray | None]] = []
        """Of each `observe` since the last chunk: views, states, frames of the video, and the
        actions that led to the others, where they were given.
        """
        self._current: Mapping[str, Any] = {}
        self.connection: Connection | None = None

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        rendered: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames as `Episode.observe` does, and keep them for the next request.

        Raises:
            UserError: also where some frames have no image.
        """
        super().observe(frames, states, is_demo, actions, rendered)
        count = len(states)
        names = (*self._robot.camera_names, *self._robot.readings)
        views = {name: np.asarray(frames[name]) for name in names}
        require(
            all(len(view) == count for view in views.values()),
            "A server reads every frame, and some were not rendered: set draw=all.",
        )
        if count:
            self._current = {name: view[-1] for name, view in views.items()}
        n_video = int(np.broadcast_to(np.asarray(is_demo, bool), (count,)).sum())
        self._new.append((views, np.asarray(states, np.float32), n_video, actions))

    def take_frames(self) -> NewFrames:
        """What was observed since the last chunk; it is not held any longer."""
        require(self._new, "A served policy needs a new frame before each chunk.")
        views_of_parts, states, n_video, actions = zip(*self._new, strict=True)
        self._new = []
        views = {}
        for name in views_of_parts[0]:
            parts = [part[name] for part in views_of_parts]
            # A part without frames, of a choice that moved nothing, has no size of its own.
            views[name] = np.concatenate([part for part in parts if len(part)] or parts[:1])
        leading = [part for part in actions if part is not None]
        executed = np.concatenate(leading, dtype=np.float32) if leading else None
        return NewFrames(
            goal=self.goal,
            subgoal=self.subgoal,
            options=self.options,
            views=views,
            states=np.concatenate(states),
            current=self._current,
            state=self.state.numpy(),
            n_video=sum(n_video),
            executed=executed,
            first=self.connection is None,
            seed=self._seed,
        )

    def fail(self, failure: Failure) -> None:
        """Note that this episode cannot continue, and close its connection."""
        self._failure = failure
        self.close()

    def restart_clock(self) -> None:
        """Not offered: the clock is the server's."""
        raise UserError("event=restart: the clock of a served policy cannot be reached.")

    def add_frames(self, *_: Any, **__: Any) -> None:
        """Not offered: a server gets whole observations."""
        raise UserError("A served policy takes whole observations: observe().")

    set_view = add_frames

    def close(self) -> None:
        if self.connection is None:
            return
        connection = self.connection
        self.connection = None
        try:
            self.policy.protocol.end(connection)
        except (ConnectionError, UserError):
            return  # the server is gone, and with it the episode
        finally:
            connection.close()


@dataclass
class Traffic:
    """Requests of a run: how long each took, and how long of it the server computed, in seconds."""

    seconds: list[float] = field(default_factory=list)
    server_seconds: list[float] = field(default_factory=list)

    def add(self, seconds: float, reply: Mapping[str, Any]) -> None:
        self.seconds.append(seconds)
        timing = reply.get("server_timing")
        places = [reply, timing if isinstance(timing, Mapping) else {}]
        for place in places:
            for key in _MS_KEYS:
                value = place.get(key)
                if isinstance(value, int | float) and np.isfinite(value):
                    self.server_seconds.append(float(value) / 1e3)
                    return

    def summary(self) -> dict[str, Any]:
        """Number of requests, and medians and 95th percentiles in milliseconds."""
        summary: dict[str, Any] = {"requests": len(self.seconds)}
        columns = {"round_trip_ms": self.seconds, "server_ms": self.server_seconds}
        for name, seconds in columns.items():
            if seconds:
                half, most = 1e3 * np.percentile(seconds, [50, 95])
                summary[name] = {"p50": round(float(half), 2), "p95": round(float(most), 2)}
        return summary


class RemotePolicy(Policy):
    """A policy behind a server."""

    def __init__(self, choice: ServerChoice, robot: Embodiment, execute: int | None = None) -> None:
        """Connect once, to learn what the server is.

        Args:
            choice: the server.
            robot: of the command, for servers that do not describe theirs.
            execute: actions of a chunk that the rollout executes; None for the robot's number.

        Raises:
            UserError: there is no server, its protocol is not known, or it cannot serve this robot.
        """
        super().__init__()
        self.weights = nn.Parameter(torch.zeros(0), requires_grad=False)
        """None are here; it says where this policy is and in which precision."""
        name: str = choice.protocol
        self.detected: str | None = None
        try:
            if name == "auto":
                name, self.detected = detect(choice)
            self.protocol: ServerProtocol = PROTOCOLS[name](choice, robot)
            first = open_patiently(self.protocol.open, choice.connection.open_s)
        except UserError:
            raise
        except (ConnectionError, TimeoutError) as error:
            raise UserError(
                f"{error} Its protocol is another than {name}, or it is still loading: set"
                " protocol=… or connection.open_s=…"
            ) from None
        first.close()
        metadata = self._metadata = ServerMetadata.of(first.metadata)
        self.protocol.describe(metadata)

        robot = self.protocol.robot
        self.memory = None
        self.processor = RemoteProcessor(robot, self.protocol.subgoal is not None)
        self.horizon = robot.action.horizon
        self._execute = execute
        self._chunk_length: int | None = None
        self._lock = threading.Lock()
        self._threads = ThreadPoolExecutor(64, "server")
        self._episodes: WeakSet[RemoteEpisode] = WeakSet()
        self.traffic = Traffic()
        running = choice.connection.episodes
        if running is None and self.protocol.shares_memory:
            running = 1
        if running is None and name == "mme_vla":
            running = count_of(metadata.max_clients)
        identity = _identity(choice, name, metadata)
        self._server: dict[str, Any] = {
            "address": choice.server,
            "protocol": name,
            "metadata": brief(first.metadata, _LONGEST_METADATA),
        }
        self.info = PolicyInfo(
            sample_steps=count_of(metadata.sample_steps) or 1,
            max_actions=count_of(metadata.max_actions),
            resamples=False,
            max_running=running,
            identity=identity,
            server=self._server,
        )
        self.config = {
            "name": identity.model,
            "policy": {"name": "remote", "protocol": name},
            "embodiment": robot.to_dict(),
            "served": asdict(identity),
        }
        if self.protocol.subgoal is not None:
            self.config["subgoal_text"] = {"kind": self.protocol.subgoal}

    def start_episode(self, goal: str, seed: int = 0) -> RemoteEpisode:
        episode = RemoteEpisode(self, goal, seed)
        self._episodes.add(episode)
        return episode

    def observation(self, episodes: Sequence[Episode]) -> list[Episode]:
        """The episodes themselves: each holds what it has not sent yet."""
        return list(episodes)

    def predict_chunk(
        self,
        batch: Any,
        episodes: Sequence[Episode],
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """Request a chunk for each episode, all at the same time.

        Returns:
            [n, h, w]; NaN for episodes that have a `failure`.

        Raises:
            UserError: the server is gone, or cannot serve this run at all.
        """
        require(
            steps is None,
            "flow_steps=…: a server chooses its own; leave it out, or set it where it is started.",
        )
        remote = cast(Sequence[RemoteEpisode], episodes)
        futures = [self._threads.submit(self._request, episode) for episode in remote]
        try:
            wait(futures)
        except BaseException:  # an interrupt: requests that wait for a reply end with theirs
            for episode in remote:
                episode.close()
            raise
        chunks = [future.result() for future in futures]
        length = self._chunk_length or 1
        rows = torch.full((len(remote), length, self.embodiment.action.width), torch.nan)
        for row, chunk in zip(rows, chunks, strict=True):
            if chunk is not None:
                row[:] = torch.from_numpy(chunk)
        return rows

    def close(self) -> None:
        """Close all connections."""
        for episode in list(self._episodes):
            episode.close()
        self._threads.shutdown(wait=False)

    def _request(self, episode: RemoteEpisode) -> np.ndarray | None:
        """The next chunk [h, w] of an episode; None after a failure."""
        if episode.failure is not None:
            return None
        frames = episode.take_frames()
        try:
            if episode.connection is None:
                self._begin(episode, frames)
            reply = self._ask(episode, frames)
            return self._chunk(reply)
        except (ConnectionError, TimeoutError) as error:
            # It may have taken the frames or not: only the whole episode can be tried again.
            episode.fail(Failure(str(error), again=True))
        except _RefusedError as error:
            episode.fail(Failure(str(error), again=False))
        return None

    def _begin(self, episode: RemoteEpisode, frames: NewFrames) -> None:
        """Open the episode's connection and begin it.

        A connection that is lost before the episode has begun is opened again: nothing was sent
        that counts.

        Raises:
            UserError: there is no server, or the policy behind it is another by now.
        """
        settings = self.protocol.choice.connection

        def begin() -> Connection:
            connection = self.protocol.open()
            now = ServerMetadata.of(connection.metadata)
            differ = [key for key in DECISIVE if getattr(now, key) != getattr(self._metadata, key)]
            if self.protocol.name == "mme_vla" and differ:
                connection.close()
                raise UserError(
                    f"{self._server['address']} serves another policy than at the start of this run"
                    f" ({listed(differ)} in its metadata). Serve the first again and repeat the"
                    " command, or choose another output."
                )
            try:
                self.protocol.begin(connection, frames)
            except UserError as error:
                connection.close()
                raise _RefusedError(str(error)) from None
            except BaseException:
                connection.close()
                raise
            return connection

        episode.connection = open_patiently(begin, settings.open_s)

    def _ask(self, episode: RemoteEpisode, frames: NewFrames) -> dict[str, Any]:
        """The reply to the episode's new frames."""
        begun = time.perf_counter()
        try:
            reply = self._act(episode, frames)
        except ConnectionError:
            was_closed_here = episode.connection is None  # at an interrupt
            if was_closed_here or not self.protocol.stateless:
                raise
            # A server without a memory can be asked the same once more.
            self._begin(episode, frames)
            reply = self._act(episode, frames)
        with self._lock:
            self.traffic.add(time.perf_counter() - begun, reply)
            self._server["times"] = self.traffic.summary()
        return reply

    def _act(self, episode: RemoteEpisode, frames: NewFrames) -> dict[str, Any]:
        assert episode.connection is not None
        try:
            return self.protocol.act(episode.connection, frames)
        except UserError as error:
            raise _RefusedError(str(error)) from None

    def _chunk(self, reply: Mapping[str, Any]) -> np.ndarray:
        """The chunk [h, w] float32 of a reply, checked.

        Raises:
            _RefusedError: it is malformed.
            UserError: `execute` does not fit the server's chunks.
        """
        width = self.embodiment.action.width
        actions = reply.get("actions")
        problem = None
        if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "fiu":
            problem = f"actions are {brief(actions)}"
        elif actions.ndim != 2 or actions.shape[1] != width:
            problem = f"actions have the shape {list(actions.shape)}"
        elif not 1 <= len(actions) <= LONGEST_CHUNK:
            problem = f"{len(actions)} actions"
        elif not np.isfinite(actions).all():
            problem = "actions that are not finite"
        elif (largest := np.abs(actions.astype(np.float64)).max()) > LARGEST_ACTION:
            problem = f"an action of {largest:.3g}"
        if problem is not None:
            raise _RefusedError(
                f"The server's reply is malformed: {problem}; expected numbers [actions, {width}],"
                f" none larger than {LARGEST_ACTION:g}."
            )
        assert isinstance(actions, np.ndarray)
        length = len(actions)
        with self._lock:
            if self._chunk_length is None:
                # The length of the first chunk, beside what the rollout executes of it.
                server = self.protocol.choice.server
                require(
                    self._execute is None or self._execute <= length,
                    f"execute={self._execute}: {server} returns {length} actions a chunk. Set"
                    f" execute to {length} or less, or have the server return more.",
                )
                executed = self._execute or self.embodiment.action.execute
                require(
                    executed >= length or not self.protocol.executes_all,
                    f"{server} returns {length} actions a chunk, and the challenge executes all of"
                    f" them: set execute={length}.",
                )
                self._chunk_length = length
        if length != self._chunk_length:
            raise _RefusedError(
                f"The server's reply is malformed: {length} actions, and {self._chunk_length} in"
                " replies before."
            )
        return np.ascontiguousarray(actions, np.float32)


class _RefusedError(Exception):
    """The server refuses a request, or its reply cannot be read: another try would end alike."""


def _identity(choice: ServerChoice, protocol: str, metadata: ServerMetadata) -> PolicyIdentity:
    """What records call a served policy: what the command says, else the server, else the
    protocol.
    """
    connection = choice.connection
    described = metadata.identity if protocol == "mme_vla" else None
    if isinstance(described, Mapping):
        identity = read_section(PolicyIdentity, described, "the server's identity")
        # These name folders of this machine.
        if connection.name is None:
            safe_name(identity.model, "the server's name of its policy (connection.name)")
        if connection.checkpoint is None:
            checkpoint = str(identity.checkpoint)
            safe_name(checkpoint, "the server's name of its checkpoint (connection.checkpoint)")
        return PolicyIdentity(
            connection.name or identity.model,
            identity.checkpoint if connection.checkpoint is None else connection.checkpoint,
            identity.memory_budget,
            identity.composition,
            identity.training,
        )
    return PolicyIdentity(connection.name or protocol, connection.checkpoint or "served")
