"""A policy server in a thread of the test's own process, and the messages clients send it."""

import asyncio
import http.client
import threading
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any
from unittest.mock import patch

import numpy as np

from mme_vla.policy.mme import MMEPolicy
from mme_vla.serving import Client, PolicyServer, ServeSettings
from mme_vla.testing.small import SMALL_VISION, moving_frames, small_policy

GOAL = "pick up the cube"


def serving_policy(name: str = "tokendrop_expert", **overrides: Any) -> MMEPolicy:
    """Eight by eight patches an image: most of a request's time would be the tower's."""
    return small_policy(name, backbone={"vision": {**SMALL_VISION, "patch_size": 8}}, **overrides)


class Reading:
    """Of a video without end: whether reading has begun, whether it is enough, whether
    it is over.
    """

    def __init__(self) -> None:
        self.begun, self.enough, self.over = threading.Event(), threading.Event(), threading.Event()

    def longer(self, steps: Iterator[None]) -> Iterator[None]:
        self.begun.set()
        try:
            yield from steps
            while not self.enough.wait(0.001):
                yield
        finally:
            self.over.set()


class Served:
    """Runs a server until the `with` block ends. `on_loop` runs a coroutine where the
    server runs.
    """

    def __init__(self, policy: MMEPolicy, source: str | None = None, **settings: Any) -> None:
        self.server: PolicyServer
        self._policy = policy
        self._source = source
        self._settings = ServeSettings(
            **{"port": 0, "flow_steps": 2, "encode_chunk": 16, "max_batch": 8, **settings}
        )
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)

    def __enter__(self) -> "Served":
        self._thread.start()
        self.on_loop(self._start())
        return self

    async def _start(self) -> None:
        name = "test" if self._source is None else ""
        self.server = PolicyServer(
            self._policy, self._settings, name=name, trained=False, source=self._source
        )
        await self.server.start()

    def __exit__(self, *_: object) -> None:
        if not self.server.places.stopping:
            self.on_loop(self.server.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)

    def on_loop(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(60)

    @property
    def address(self) -> tuple[str, int]:
        return "127.0.0.1", self.server.port

    @property
    def busy(self) -> int:
        """Clients that wait for an answer."""
        return len(self.server.places.taken) - len(self.server.places.waiting())

    @contextmanager
    def reading(self) -> Iterator["Reading"]:
        """Within the block the first video, once it is read, continues being read: one of any
        length.
        """
        state, engine = Reading(), self.server.engine
        begin = engine.run

        async def run(steps: Iterator[None], pieces: int = 1) -> None:
            first = pieces > 1 and not state.begun.is_set()
            await (begin(state.longer(steps), 10**6) if first else begin(steps, pieces))

        with patch.object(engine, "run", run):
            try:
                yield state
            finally:
                state.enough.set()

    def client(self, **options: Any) -> Client:
        return Client(f"ws://127.0.0.1:{self.server.port}", **{"timeout": 60, **options})


def wait_until(true: Callable[[], bool], seconds: float = 30) -> None:
    waited = threading.Event()
    for _ in range(int(seconds / 0.02)):
        if true():
            return
        waited.wait(0.02)
    raise AssertionError("it did not happen in time")


def states(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (count, 8)).astype(np.float32)


def challenge(
    front: np.ndarray, wrist: np.ndarray, state: np.ndarray, first: bool, **more: Any
) -> dict[str, Any]:
    """A request of the challenge's schema, with the keys a server has no use for."""
    return {
        "task_goal": [GOAL, "another wording"],
        "is_first_step": first,
        "front_rgb_list": list(front),
        "wrist_rgb_list": list(wrist),
        "joint_state_list": [row[:7] for row in state],
        "eef_state_list": [np.zeros(6) for _ in state],
        "gripper_state_list": [np.repeat(row[7:], 2) for row in state],
        **more,
    }


def observation(
    front: np.ndarray, wrist: np.ndarray, state: np.ndarray, **more: Any
) -> dict[str, Any]:
    return {
        "observation/image": front,
        "observation/wrist_image": wrist,
        "observation/state": state,
        "prompt": GOAL,
        **more,
    }


def course(
    seed: int = 0, video: int = 9, rounds: int = 2
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """(front, wrist, state) of an episode's messages: video and current frame, then 16 frames a
    round.
    """
    total = video + 1 + 16 * rounds
    front, wrist, state = (
        moving_frames(total, seed=seed),
        moving_frames(total, seed=seed + 100),
        states(total, seed),
    )
    bounds = [0, video + 1, *(video + 1 + 16 * (i + 1) for i in range(rounds))]
    return [(front[a:b], wrist[a:b], state[a:b]) for a, b in pairwise(bounds)]


def acted_directly(
    policy: MMEPolicy, parts: list, steps: int = 2, seed: int = 42, **subgoal: str
) -> list[np.ndarray]:
    """The chunks of the same episode without a server."""
    episode, chunks = policy.start_episode(GOAL, seed=seed), []
    for index, (front, wrist, state) in enumerate(parts):
        demo = np.arange(len(front)) < (len(front) - 1 if index == 0 else 0)
        episode.observe({"front": front, "wrist": wrist}, state, demo)
        episode.subgoal = subgoal.get("subgoal")
        chunks.append(policy.act([episode], steps)[0])
    return chunks


def ask(
    served: Served, method: str, path: str, body: bytes | None = None, **headers: str
) -> tuple[int, str, bytes]:
    connection = http.client.HTTPConnection(*served.address, timeout=60)
    connection.request(
        method, path, body, {name.replace("_", "-"): value for name, value in headers.items()}
    )
    response = connection.getresponse()
    result = response.status, response.headers["Content-Type"], response.read()
    connection.close()
    return result
