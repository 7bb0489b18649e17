"""What is said to each kind of server: how an episode begins, how it continues, what a reply holds.

| protocol | before the first chunk | at each chunk |
|---|---|---|
| `mme_vla` | reset, with the seed of the noise | all frames of all cameras since the last chunk |
| `robomme` | reset | frames of the memory camera (`add_buffer`), then the current observation |
| `openpi` | a connection of its own | the current observation |
| `challenge` | reset | all frames since the last chunk, in the benchmark's lists |
| `harness` | the episode's start | each frame by itself, the video with the first |
"""

from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np

from mme_vla.config.sections import read_section
from mme_vla.embodiment import Embodiment, Option
from mme_vla.embodiment.robomme import ARM_JOINTS, CAMERAS
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.serving.client import Client
from mme_vla.serving.remote.connections import (
    STARTUP_S,
    Connection,
    HarnessConnection,
    HttpConnection,
    open_patiently,
)
from mme_vla.serving.remote.settings import ServerChoice, Subgoals
from mme_vla.serving.requests import released_keys

SERVER_NAME = "mme_vla"  # what this library's server calls itself
LONGEST_CHUNK = 4096  # actions


@dataclass(frozen=True)
class ServerMetadata:
    """What a server says of itself. The keys are those of this library's servers, and
    `observation_params` of the harness; on another server one may mean anything.
    """

    server: Any = None
    version: Any = None
    robot: Any = None
    horizon: Any = None
    execute: Any = None
    subgoal: Any = None
    identity: Any = None
    observation_params: Any = None
    sample_steps: Any = None
    max_actions: Any = None
    max_clients: Any = None

    @classmethod
    def of(cls, metadata: Mapping[str, Any]) -> Self:
        """Read the metadata that a connection got."""
        return read_section(cls, metadata, "the server's metadata", others=True)


@dataclass
class NewFrames:
    """What an episode observed since its last chunk, the current frame last; no frame after a
    choice that moved nothing.

    goal: the task in words.
    subgoal: its current part, if a predictor gives one.
    options: what can be chosen.
    views: by camera or reading, arrays or lists of t.
    states: [t, s] float32. current,
    state: the current frame, by camera or reading, and its state, which are there in any case.
    n_video: how many of the frames are of the conditioning video; these come first.
    executed: actions [k, w] that led to the last k frames.
    first: whether the episode begins.
    seed: of its noise.
    """

    goal: str
    subgoal: str | None
    options: tuple[Option, ...]
    views: Mapping[str, Any]
    states: np.ndarray
    current: Mapping[str, Any]
    state: np.ndarray
    n_video: int
    executed: np.ndarray | None
    first: bool
    seed: int


class ServerProtocol:
    """One way to talk to a server.

    shares_memory: whether its servers may have one memory for all connections, so that one episode
        runs at a time.
    stateless: whether a request that got no reply may be sent again on another connection.
    executes_all: whether the protocol has every action of a chunk executed.
    connection_type: the connections it talks over.
    """

    name: ClassVar[str]
    shares_memory: ClassVar[bool] = False
    stateless: ClassVar[bool] = False
    executes_all: ClassVar[bool] = False
    connection_type: type[Connection] = Client

    def __init__(self, choice: ServerChoice, robot: Embodiment) -> None:
        """Take the robot of the command; `describe` may replace it by the server's."""
        self.choice = choice
        self.robot = robot
        self.subgoal: str | None = None
        if choice.connection.subgoal is not None:
            self.subgoal = f"{choice.connection.subgoal}_subgoal"
        require(
            not choice.connection.keys or self.name == "openpi",
            f"connection.keys are for protocol=openpi; this server has {self.name}.",
        )
        self.check()

    def check(self) -> None:
        """Refuse a robot whose observations the protocol has no place for."""
        require(
            not self.robot.readings,
            f"The robot {self.robot.name!r} reads {', '.join(self.robot.readings)}, and"
            f" protocol={self.name} has no place for them.",
        )

    def open(self) -> Connection:
        """Open a connection; once, without patience."""
        settings = self.choice.connection
        return self.connection_type(
            self.choice.server,
            api_key=settings.api_key,
            timeout=settings.timeout_s,
            open_timeout=settings.open_s,
        )

    def describe(self, metadata: ServerMetadata) -> None:
        """Take what the server says of itself."""

    def begin(self, connection: Connection, frames: NewFrames) -> None:
        """Begin an episode on a connection that has none."""
        reply = connection.request({"reset": True})
        if reply.get("reset_finished") is not True:
            raise UserError(
                f"The server's reply is malformed: {brief(reply)} after a reset, which needs"
                " reset_finished."
            )

    def act(self, connection: Connection, frames: NewFrames) -> dict[str, Any]:
        """Send frames; return the reply, whose `actions` are the chunk."""
        raise NotImplementedError

    def end(self, connection: Connection) -> None:
        """Tell the server that the episode is over, where the protocol has a word for it."""

    def observation(self, frames: NewFrames) -> dict[str, Any]:
        """The current frame as openpi's servers read it."""
        keys = self.choice.connection.keys or {}
        released = released_keys(self.robot)
        message: dict[str, Any] = {}
        for name in self.robot.camera_names:
            key = released.get(name, f"observation/{name}")
            message[keys.get(name, key)] = np.ascontiguousarray(frames.current[name])
        message[keys.get("state", "observation/state")] = frames.state
        message[keys.get("prompt", "prompt")] = frames.goal
        return message | self._subgoal_field(frames)

    def _subgoal_field(self, frames: NewFrames) -> dict[str, Any]:
        if self.subgoal is None or frames.subgoal is None:
            return {}
        return {self.subgoal: frames.subgoal}


class LibraryProtocol(ServerProtocol):
    """This library's server, with its extensions of the challenge's lists: any robot, a seed, the
    executed actions.
    """

    name = "mme_vla"

    def check(self) -> None:
        """Every robot has a place."""

    def describe(self, metadata: ServerMetadata) -> None:
        require(
            metadata.server == SERVER_NAME,
            f"protocol=mme_vla: {self.choice.server} is no server of this library; set"
            " protocol=auto.",
        )
        require(
            metadata.robot is not None,
            f"{self.choice.server} is a server of version {brief(metadata.version)}, which"
            " describes no robot: update it, or set protocol=challenge.",
        )
        robot = Embodiment.from_dict(metadata.robot)
        robot = robot.with_horizon(_actions_of(metadata, "horizon"))
        action = replace(robot.action, execute=_actions_of(metadata, "execute"))
        self.robot = replace(robot, action=action)
        if metadata.subgoal is not None:
            self.subgoal = _subgoal_kind(str(metadata.subgoal))

    def begin(self, connection: Connection, frames: NewFrames) -> None:
        connection.request({"reset": True, "seed": frames.seed})

    def act(self, connection: Connection, frames: NewFrames) -> dict[str, Any]:
        message: dict[str, Any] = {
            "task_goal": [frames.goal],
            "is_first_step": frames.first,
            "state_list": frames.states,
            **_lists(self.robot, frames),
            **self._subgoal_field(frames),
        }
        if frames.first:
            message["exec_start_idx"] = frames.n_video
        action = self.robot.action
        if frames.executed is not None and action.frames is not None:
            message["executed_action_list"] = frames.executed
        if action.answers is not None:
            message["action_space"] = action.answers
        if frames.options:
            message["available_multi_choices"] = [option.to_dict() for option in frames.options]
        return connection.request(message)


class ChallengeProtocol(ServerProtocol):
    """The RoboMME challenge's, by websocket or HTTP."""

    name = "challenge"
    shares_memory = True
    executes_all = True

    def check(self) -> None:
        robot = self.robot
        require(
            robot.action.space is not None
            and robot.state.width == ARM_JOINTS + 1
            and set(robot.camera_names) <= set(CAMERAS),
            f"The robot {robot.name!r} is not the benchmark's, and protocol={self.name} has no"
            " place for its observations.",
        )
        if self.choice.is_http:
            self.connection_type = HttpConnection

    def act(self, connection: Connection, frames: NewFrames) -> dict[str, Any]:
        # The benchmark's gripper has two fingers that move alike.
        grippers = np.repeat(frames.states[:, ARM_JOINTS:], 2, axis=1)
        return connection.request({
            "task_goal": [frames.goal],
            "is_first_step": frames.first,
            **_lists(self.robot, frames),
            "joint_state_list": list(frames.states[:, :ARM_JOINTS]),
            "gripper_state_list": list(grippers),
            **self._subgoal_field(frames),
        })  # fmt: skip


class RobommeProtocol(ServerProtocol):
    """The released server of RoboMME's policies: openpi's messages, and a buffer of past frames."""

    name = "robomme"
    shares_memory = True

    def act(self, connection: Connection, frames: NewFrames) -> dict[str, Any]:
        if len(frames.states):
            images = np.stack(list(frames.views[self.robot.memory_camera]))
            added = connection.request({
                "add_buffer": True,
                "images": images[:, None],
                "state": frames.states,
                "exec_start_idx": frames.n_video,
            })  # fmt: skip
            if added.get("add_buffer_finished") is not True:
                raise UserError(
                    f"The server's reply is malformed: {brief(added)} after frames, which needs"
                    " add_buffer_finished."
                )
        return connection.request(self.observation(frames))


class OpenpiProtocol(ServerProtocol):
    """openpi's policy server, and those with its messages: the current frame alone."""

    name = "openpi"
    stateless = True

    def begin(self, connection: Connection, frames: NewFrames) -> None:
        """Nothing is said: the protocol knows no episodes."""

    def act(self, connection: Connection, frames: NewFrames) -> dict[str, Any]:
        return connection.request(self.observation(frames))


class HarnessProtocol(ServerProtocol):
    """vla-evaluation-harness: one observation, one action. The server cuts its own chunks."""

    name = "harness"
    connection_type = HarnessConnection
    views: ClassVar[Mapping[str, str]] = {CAMERAS[0]: "agentview", CAMERAS[1]: "wrist"}
    """The harness's names of the benchmark's cameras; others keep theirs."""

    def describe(self, metadata: ServerMetadata) -> None:
        params = metadata.observation_params
        if isinstance(params, Mapping) and params.get("send_subgoal") is True:
            kind = params.get("subgoal_mode", "grounded")
            self.subgoal = self.subgoal or _subgoal_kind(f"{kind}_subgoal")
        self.robot = self.robot.with_horizon(1)

    def begin(self, connection: Connection, frames: NewFrames) -> None:
        assert isinstance(connection, HarnessConnection)
        connection.send("episode_start", {"task": {"name": frames.goal}})

    def act(self, connection: Connection, frames: NewFrames) -> dict[str, Any]:
        # Frames between two decisions, of an event that holds the robot, get actions that are not
        # executed.
        # Without a new frame the current one is observed again.
        reply: dict[str, Any] = {}
        for number in range(frames.n_video, max(len(frames.states), 1)):
            views, state = frames.current, frames.state
            if number < len(frames.states):
                views = {name: view[number] for name, view in frames.views.items()}
                state = frames.states[number]
            images = {}
            for name in self.robot.camera_names:
                images[self.views.get(name, name)] = np.ascontiguousarray(views[name])
            message: dict[str, Any] = {
                "images": images,
                "task_description": frames.goal,
                "states": state,
            }
            if self.subgoal is not None and frames.subgoal is not None:
                message["subgoal"] = frames.subgoal
            if number == frames.n_video and frames.n_video:
                video = frames.views[self.robot.memory_camera]
                message["video_history"] = list(video[: frames.n_video])
            reply = connection.request(message)
        try:
            action = np.asarray(reply.get("actions"))
        except ValueError:  # lists of several lengths
            raise UserError(
                f"The server's reply is malformed: actions are {brief(reply.get('actions'))}."
            ) from None
        if action.ndim == 1:
            action = action[None]
        return {**reply, "actions": action}

    def end(self, connection: Connection) -> None:
        assert isinstance(connection, HarnessConnection)
        connection.send("episode_end", {})


PROTOCOLS: Mapping[str, type[ServerProtocol]] = {
    kind.name: kind
    for kind in (
        LibraryProtocol,
        RobommeProtocol,
        OpenpiProtocol,
        ChallengeProtocol,
        HarnessProtocol,
    )
}


def detect(choice: ServerChoice) -> tuple[str, str]:
    """The protocol of a server, and how it was recognised.

    Raises:
        UserError: no server, or one with none of the protocols.
    """
    connection = choice.connection
    if choice.is_http:
        return "challenge", "it has HTTP"

    # All but the harness's servers send their metadata first.
    settings: dict[str, Any] = {"api_key": connection.api_key, "timeout": connection.timeout_s}
    briefly = min(STARTUP_S, connection.open_s)
    connect = partial(Client, choice.server, **settings, open_timeout=briefly)
    try:
        client = open_patiently(connect, connection.open_s)
    except TimeoutError:
        HarnessConnection(choice.server, **settings, open_timeout=connection.open_s).close()
        return "harness", "it waits for a greeting and returns one"
    with closing(client):
        if ServerMetadata.of(client.metadata).server == SERVER_NAME:
            return "mme_vla", "its metadata say so"
        try:
            reply = client.request({"reset": True})
        except (UserError, ConnectionError):
            return "openpi", "it knows no reset"
        if "reset_finished" not in reply:
            return "openpi", "it takes a reset for an observation"
        if "reset_time_ms" in reply:
            return "robomme", "it times a reset, as the released server"
        return "challenge", "it knows a reset, and does not time it"


def _lists(robot: Embodiment, frames: NewFrames) -> dict[str, Any]:
    """Images and readings of all frames, by the challenge's keys."""
    lists: dict[str, Any] = {}
    for name in robot.camera_names:
        lists[f"{name}_rgb_list"] = list(frames.views[name])
    for name in robot.readings:
        lists[f"{name}_list"] = list(frames.views[name])
    return lists


def _subgoal_kind(text: str) -> str:
    kinds = [f"{kind}_subgoal" for kind in get_args(Subgoals)]
    require(
        text in kinds,
        f"The server's metadata are malformed: it reads {brief(text)}, which is none of"
        f" {listed(kinds)}.",
    )
    return text


def count_of(value: Any) -> int | None:
    """A whole number from 1 on of a server's metadata; None where it gives none."""
    if isinstance(value, int) and not isinstance(value, bool) and value >= 1:
        return value
    return None


def _actions_of(metadata: ServerMetadata, key: Literal["horizon", "execute"]) -> int:
    """A number of actions, which the metadata must have."""
    value = getattr(metadata, key)
    count = count_of(value)
    require(
        count is not None and count <= LONGEST_CHUNK,
        f"The server's metadata are malformed: {key}={brief(value)} must be a whole"
        f" number from 1 to {LONGEST_CHUNK}.",
    )
    assert count is not None
    return count
