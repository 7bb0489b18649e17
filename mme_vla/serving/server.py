"""`PolicyServer`: one asyncio process, one port, websocket and HTTP, many clients, one policy."""

import asyncio
import logging
import time
from contextlib import suppress
from importlib.metadata import version
from typing import Any

import numpy as np

from mme_vla.embodiment import Option
from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import missing_extra
from mme_vla.policy.base import Policy
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.serving.codec import pack
from mme_vla.serving.engine import Engine, ServerStats
from mme_vla.serving.settings import ServeSettings, listen


def warm_up(policy: Policy, settings: ServeSettings) -> None:
    """Encode a piece of video and choose chunks, alone and as a pair; nothing of it is kept."""
    robot, count = policy.embodiment, settings.encode_chunk
    # Black images of every camera, and a wall at no distance where it reads depth.
    frames: dict[str, np.ndarray] = {}
    beside = (
        np.zeros((count, SIDE, SIDE, 1), np.float32),
        np.tile(np.eye(3, 4, dtype=np.float32), (count, 1, 1)),
    )
    for camera in robot.cameras:
        frames[camera.name] = np.zeros((count, SIDE, SIDE, 3), np.uint8)
        frames |= dict(zip(camera.readings, beside, strict=False))
    episodes = [
        policy.start_episode("warm up", seed=settings.seed)
        for _ in range(min(2, settings.max_batch))
    ]
    for episode in episodes:
        episode.subgoal, episode.options = "warm up", (Option("a", "warm up"),)
        episode.observe(frames, np.zeros((count, robot.state.width), np.float32))
    policy.act(episodes[:1], settings.flow_steps)
    policy.act(episodes, settings.flow_steps)


try:
    import uvicorn

    from mme_vla.serving.app import make_app
    from mme_vla.serving.connections import Connections, timed_protocol
    from mme_vla.serving.session import HttpSessions
except ImportError as error:
    raise missing_extra("Serving", "serve") from error

logger = logging.getLogger("mme_vla.serving")
STOPPING = "The server is stopping."
HEAD = 2**16  # bytes of request line and headers


class PolicyServer:
    """Serves a policy.

    Use: `await server.start()`, later `await server.stop()`; both in one event loop. Each
    connection has an episode of its own, which ends with it.

    Args:
        policy: with normalisation statistics, in eval mode, on its device.
        settings: how to serve.
        name: what metadata call the policy. trained: False says that its weights are fresh.
    """

    def __init__(
        self, policy: Policy, settings: ServeSettings, *, name: str = "", trained: bool = True
    ) -> None:
        policy.require_processor().require_stats()
        settings.check_robot(policy.embodiment, policy.require_processor().prompt_spec.past_actions)
        self.settings, self.stats = settings, ServerStats()
        self.engine = Engine(policy, settings.max_batch, settings.flow_steps, self.stats)
        self.metadata = _metadata(policy, settings, name, trained)
        self.port = settings.port
        self.connections = Connections(settings.limits, self.stats)
        self.sessions = HttpSessions(self.engine, settings)
        self._background: set[asyncio.Task[Any]] = set()
        self._uvicorn: uvicorn.Server | None = None

    async def start(self) -> None:
        begun = time.perf_counter()
        await self.engine.call(lambda: warm_up(self.engine.policy, self.settings))
        logger.info("warmed up in %.1f s", time.perf_counter() - begun)
        bound = listen(self.settings.host, self.settings.port)
        self.engine.start()
        config = self._config()
        config.load()
        self._uvicorn = uvicorn.Server(config)
        self._uvicorn.lifespan = config.lifespan_class(
            config
        )  # `serve()` would take over the signals of the process
        await self._uvicorn.startup(sockets=[bound])
        self.port = bound.getsockname()[1]
        for work in (
            self._log_regularly(),
            self.connections.watch(),
            self.sessions.forget_silent(),
        ):
            self._background.add(asyncio.get_running_loop().create_task(work))

    def _config(self) -> uvicorn.Config:
        limits = self.settings.limits
        return uvicorn.Config(
            make_app(
                self.engine, self.settings, pack(self.metadata), self.connections, self.sessions
            ),
            http=timed_protocol(self.connections),
            ws="websockets-sansio",
            ws_max_size=limits.message_bytes,
            ws_per_message_deflate=False,
            ws_ping_timeout=limits.pong_s,
            h11_max_incomplete_event_size=HEAD,
            timeout_keep_alive=int(limits.idle_s) + 60,  # `Connections` is stricter
            timeout_graceful_shutdown=1,
            lifespan="off",
            log_config=None,
            log_level=logging.CRITICAL + 1,  # failed handshakes of clients print no traceback
            access_log=False,
            proxy_headers=False,  # a session belongs to the address that connects, not to a header
            server_header=False,
            date_header=False,
        )

    async def stop(self) -> None:
        """Refuse new clients, finish the requests that are running, close every connection with a
        reason.
        """
        connections, server = self.connections, self._uvicorn
        connections.stopping = True
        for task in self._background:
            task.cancel()
        if server is not None:
            for listener in server.servers:
                listener.close()
            connections.close_idle(1001, STOPPING)
            with suppress(TimeoutError):
                async with asyncio.timeout(self.settings.limits.stop_s):
                    while any(connection.is_open for connection in connections.open.values()):
                        await asyncio.sleep(0.02)
            await server.shutdown()
            connections.abort()
        self.sessions.entries.clear()
        await self.engine.stop()

    async def _log_regularly(self) -> None:
        before = 0
        while True:
            await asyncio.sleep(self.settings.log_every_s)
            if (total := self.stats.counts.total()) != before:
                logger.info("%s", self.stats.line())
            before = total


def _metadata(policy: Policy, settings: ServeSettings, name: str, trained: bool) -> dict[str, Any]:
    limits = settings.limits
    return {
        "server": "mme_vla",
        "version": version("mme-vla"),
        "model": name,
        "trained": trained,
        "embodiment": policy.embodiment.name,
        "cameras": list(policy.embodiment.camera_names),
        "memory_camera": policy.embodiment.memory_camera,
        "readings": list(policy.embodiment.readings),
        "state_dim": policy.embodiment.state.width,
        "action_space": policy.embodiment.action.answers,
        "action_dim": policy.embodiment.action.width,
        "horizon": policy.horizon - policy.require_processor().samples.window + 1,
        "execute": settings.executed(policy.embodiment),
        "remembers_frames": policy.memory is not None,
        "subgoal": subgoal_kind(policy),
        "schemas": ["mme_vla", "robomme_challenge"],
        "limits": {"message_bytes": limits.message_bytes, "frames": limits.frames},
    }
