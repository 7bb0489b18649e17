"""A policy behind AI2's vla-evaluation-harness (package `vla-eval`): every frame is remembered,
sessions act together.

The harness sends one observation a step and asks for one action. Most are answered out of the chunk
under way; their frames count all the same, and are handed to the episode when the next chunk is
chosen.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

import numpy as np

from mme_vla.config.devices import find_device
from mme_vla.embodiment.robomme import CAMERAS, check_benchmark
from mme_vla.errors import UserError, missing_extra, require
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.serving.settings import Limits, ServeSettings, is_local

try:
    from jsonargparse import ActionConfigFile, ArgumentParser
    from vla_eval.model_servers import serve as harness_serving
    from vla_eval.model_servers.base import SessionContext
    from vla_eval.model_servers.predict import PredictModelServer
    from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW, DimSpec
    from websockets.asyncio.server import serve as websocket_server
except ImportError as error:
    raise missing_extra("A model server of vla-evaluation-harness", "harness") from error

logger = logging.getLogger("mme_vla.serving")
VIEWS = {"front": "agentview", "wrist": "wrist"}
"""The harness's names of the cameras."""
SPACES = ("joint_angle", "ee_pose")
"""Action spaces of its RoboMME in which a step is a frame."""


@dataclass
class Running:
    """One session's episode, and the observations since its last chunk: images by camera, and
    states.
    """

    episode: Episode
    images: list[dict[str, np.ndarray]] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)


class MMEVLAModelServer(PredictModelServer):
    """Serves a checkpoint of this library to RoboMME in the harness.

    Args:
        checkpoint: folder, or owner/name of a hub repository; or a policy that is there already.
        device: auto, cpu or cuda.
        dtype: of the weights; bfloat16 halves the memory.
        execute: actions of a chunk that are executed; by default the embodiment's.
        flow_steps: of an iterative head; by default its own.
        seed: of every episode's noise.
        trust_plugins: import the modules that the checkpoint names: their authors' code.
        max_batch_size: most sessions that act together.
        max_wait_time: seconds to wait for more of them.
    """

    def __init__(
        self,
        checkpoint: str | Policy,
        device: str = "auto",
        dtype: str = "float32",
        execute: int | None = None,
        flow_steps: int | None = None,
        seed: int = 42,
        trust_plugins: bool = False,
        *,
        max_batch_size: int = 16,
        max_wait_time: float = 0.01,
    ) -> None:
        if not isinstance(checkpoint, Policy):
            place = find_device(device)
            checkpoint = Policy.from_pretrained(
                checkpoint, device=place, dtype=dtype, trust_plugins=trust_plugins
            )
        self.policy = checkpoint.eval()
        robot = self.policy.embodiment
        check_benchmark(robot, SPACES)
        require(
            not robot.readings,
            f"This policy reads {', '.join(robot.readings)}, which the harness does not send: it"
            " cannot be served to it. Evaluate it with mme-vla evaluate.",
        )
        require(
            not robot.action.of_pose,
            f"This policy returns differences to poses ({robot.action.answers}), which the harness"
            " does not execute: it cannot be served to it. Evaluate it with python -m"
            " mme_vla.evaluate.",
        )
        settings = ServeSettings(execute=execute, flow_steps=flow_steps, seed=seed)
        settings.check_robot(robot, self.policy.require_processor().prompt_spec.past_actions)
        self.flow_steps = flow_steps
        self.seed = seed
        self.subgoal = subgoal_kind(self.policy)
        self.sessions: dict[str, Running] = {}
        super().__init__(
            chunk_size=settings.executed(robot),
            max_batch_size=max_batch_size,
            max_wait_time=max_wait_time,
        )

    def get_observation_params(self) -> dict[str, Any]:
        robot = self.policy.embodiment
        params: dict[str, Any] = {
            "send_state": True,
            "send_video_history": True,
            "action_space": robot.action.space,
        }
        params["send_wrist_image"] = CAMERAS[1] in robot.camera_names
        if self.subgoal is not None:
            params |= {"send_subgoal": True, "subgoal_mode": self.subgoal.removesuffix("_subgoal")}
        return params

    def get_action_spec(self) -> dict[str, DimSpec]:
        """One action, as the benchmark's action space has it."""
        return {"action": RAW}

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """The images, the state and the words that are read."""
        images = {VIEWS[name]: IMAGE_RGB for name in self.policy.embodiment.camera_names}
        spec = {**images, "state": RAW, "language": LANGUAGE}
        if self.subgoal is not None:
            spec["subgoal"] = LANGUAGE
        return spec

    async def on_episode_start(self, config: dict[str, Any], ctx: SessionContext) -> None:
        """Begin a session's episode; its goal comes with the first observation."""
        await super().on_episode_start(config, ctx)
        self.sessions[ctx.session_id] = Running(self.policy.start_episode("", seed=self.seed))

    async def on_episode_end(self, result: dict[str, Any], ctx: SessionContext) -> None:
        await super().on_episode_end(result, ctx)
        self.sessions.pop(ctx.session_id, None)

    async def on_observation(self, obs: dict[str, Any], ctx: SessionContext) -> None:
        """Take a frame, and answer with the next action."""
        running = self.sessions.get(ctx.session_id)
        if running is None:
            raise UserError("an observation came before the start of an episode.")
        images = obs.get("images") or {}
        state = obs.get("states", obs.get("state"))
        names = self.policy.embodiment.camera_names
        missing = [VIEWS[name] for name in names if images.get(VIEWS[name]) is None]
        if state is None:
            missing.append("states")
        if missing:
            raise UserError(
                f"the observation lacks {', '.join(missing)}: the environment failed, or the"
                " benchmark does not send what get_observation_params() lists."
            )
        running.images.append({name: np.asarray(images[VIEWS[name]]) for name in names})
        running.states.append(np.asarray(state, np.float32))
        await super().on_observation(obs, ctx)

    def predict_batch(
        self, obs_batch: list[dict[str, Any]], ctx_batch: list[SessionContext]
    ) -> list[dict[str, Any]]:
        """Choose the chunks of these sessions in one batch.

        A session whose frames or words cannot be read fails alone: its result holds the error.
        """
        results: list[dict[str, Any]] = []
        episodes = []
        for obs, ctx in zip(obs_batch, ctx_batch, strict=True):
            try:
                episodes.append(self._caught_up(obs, ctx))
                results.append({})
            except Exception as error:
                results.append({"error": error})
        chunks = iter(self.policy.act(episodes, self.flow_steps))
        for result in results:
            if not result:
                result["actions"] = next(chunks)
        return results

    def _normalize_result(self, result: dict[str, Any], ctx: SessionContext) -> dict[str, Any]:
        """The harness's own, called for each session by itself.

        Raises:
            Exception: the error of this session.
        """
        if "error" in result:
            raise result["error"]
        normalized: dict[str, Any] = super()._normalize_result(result, ctx)
        return normalized

    def _caught_up(self, obs: dict[str, Any], ctx: SessionContext) -> Episode:
        """A session's episode, after it has taken the frames since its last chunk."""
        running = self.sessions[ctx.session_id]
        # Taken out first: frames that cannot be read must not come back with the next call.
        frames = running.images
        states = running.states
        running.images = []
        running.states = []
        episode = running.episode
        episode.goal = str(obs["task_description"])
        episode.subgoal = obs.get("subgoal") or None
        video = obs.get("video_history")
        if video is not None and len(video):
            episode.add_frames(np.stack(video), is_demo=True)
        views = {}
        for name in frames[0]:
            views[name] = np.stack([images[name] for images in frames])
        episode.observe(views, np.stack(states))
        _ = episode.prompt  # words that cannot be read fail here, and not in a batch with others
        return episode


def serve_websockets(
    handler: Any, host: str, port: int, *, process_request: Callable[..., Any], **options: Any
) -> Any:
    """Listen as `websockets.serve` does, with the checks of the policy server: no page of a browser
    is served, and no message is longer than its limit.

    Args:
        handler, host, port, options: as the harness passes them to `websockets.serve`.
        process_request: the harness's own replies to HTTP requests.
    """

    def refuse_pages(connection: Any, request: Any) -> Any:
        if "Origin" in request.headers and request.path != "/health":
            return connection.respond(HTTPStatus.FORBIDDEN, "Pages in a browser are not served.\n")
        return process_request(connection, request)

    options["max_size"] = Limits().message_bytes
    return websocket_server(handler, host, port, process_request=refuse_pages, **options)


def main(arguments: Sequence[str] | None = None) -> None:
    """Serve with the command-line options of the harness's model servers, but on this machine alone
    by default.
    """
    parser = ArgumentParser(description="A policy behind vla-evaluation-harness.")
    parser.add_argument("--config", action=ActionConfigFile, help="YAML file with these options")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; clients send no key"
    )
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--address", help="host:port in one, before --host and --port")
    parser.add_argument("--verbose", "-v", action="store_true", help="log every message")
    parser.add_argument("--script", help="ignored; files of the harness name it")
    parser.add_class_arguments(MMEVLAModelServer, "args", fail_untyped=False, sub_configs=True)
    options = parser.parse_args(arguments)
    level = logging.DEBUG if options.verbose else logging.INFO
    logging.basicConfig(level=level, format="%(asctime)s %(name)s: %(message)s")
    host = options.host
    port = options.port
    if options.address:
        name, _, number = options.address.rpartition(":")
        require(
            number.isdecimal(),
            f"--address={options.address!r} must be host:port, such as 127.0.0.1:8000.",
        )
        host = name or host
        port = int(number)
    server = MMEVLAModelServer(**options.args.as_dict())
    if not is_local(host):
        logger.warning(
            "host=%s: every client that reaches this port can use it, the harness has no key", host
        )
    # The harness has no option for its own websocket server, which takes any origin and any size.
    harness_serving.ws_serve = serve_websockets
    harness_serving.serve(server, host=host, port=port)
