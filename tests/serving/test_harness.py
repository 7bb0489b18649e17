"""The model server of vla-evaluation-harness, driven by the harness's own runner: the numbers are
the policy's.
"""

import asyncio
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

vla_eval = pytest.importorskip(
    "vla_eval", reason="the harness is not installed: uv sync --inexact --extra harness"
)
from vla_eval.api import serve_background  # noqa: E402
from vla_eval.benchmarks.base import StepBenchmark, StepResult  # noqa: E402
from vla_eval.connection import Connection  # noqa: E402
from vla_eval.model_servers import serve as harness_serve  # noqa: E402
from vla_eval.model_servers.predict import PredictModelServer  # noqa: E402
from vla_eval.runners.base import ModelActError  # noqa: E402
from vla_eval.runners.sync_runner import SyncEpisodeRunner  # noqa: E402
from vla_eval.specs import IMAGE_RGB, LANGUAGE, RAW  # noqa: E402
from websockets.exceptions import ConnectionClosedError, InvalidStatus  # noqa: E402
from websockets.sync.client import connect  # noqa: E402
from websockets.typing import Origin  # noqa: E402

from mme_vla.embodiment import ROBOMME_JOINT  # noqa: E402
from mme_vla.errors import UserError  # noqa: E402
from mme_vla.policy.mme import MMEPolicy  # noqa: E402
from mme_vla.serving import harness  # noqa: E402
from mme_vla.serving.harness import MMEVLAModelServer, main  # noqa: E402
from mme_vla.serving.remote.policy import RemotePolicy  # noqa: E402
from mme_vla.serving.remote.settings import ServerChoice  # noqa: E402
from mme_vla.serving.settings import Limits  # noqa: E402
from mme_vla.testing.small import small_policy  # noqa: E402

STEPS, VIDEO = 37, 5
DEMO = np.arange(6) < 5


class Scripted(StepBenchmark):
    """What the harness's RoboMME sends, of an environment whose images follow the actions."""

    def __init__(self, number: int, fails_at: int | None = None) -> None:
        super().__init__()
        self.number, self.fails_at = number, fails_at
        self.rng = np.random.default_rng(number)
        self.video = [
            self.rng.integers(0, 255, (64, 64, 3), np.uint8) for _ in range(VIDEO * number)
        ]
        self.first = True
        self.state = np.zeros(8, np.float32)
        self.taken: list[np.ndarray] = []

    def observation(self) -> dict[str, Any]:
        images = self.rng.integers(0, 200, (2, 64, 64, 3), np.uint8)
        at = int(abs(self.state[0]) * 20) % 50
        images[:, at : at + 12, 20:40] = 255
        return {"images": {"agentview": images[0], "wrist": images[1]}, "states": self.state.copy(),
                "task_description": f"touch square {self.number}"}  # fmt: skip

    def reset(self, task: Any) -> dict[str, Any]:
        return self.observation()

    def step(self, action: Any) -> StepResult:
        self.taken.append(np.array(action["actions"], np.float32))
        self.state = self.taken[-1]
        return StepResult(self.observation(), 0.0, len(self.taken) == STEPS, {"status": "ongoing"})

    def make_obs(self, raw_obs: Any, task: Any) -> dict[str, Any]:
        if self.fails_at == len(self.taken):
            return {
                "images": {},
                "task_description": "",
            }  # what it sends where inverse kinematics failed
        video, self.first = (self.video if self.first else []), False
        return raw_obs | ({"video_history": video} if video else {})

    def get_tasks(self) -> list[Any]:
        return [{"name": "touch"}]

    def check_done(self, step_result: StepResult) -> bool:
        return step_result.done

    def get_step_result(self, step_result: StepResult) -> Any:
        return {"success": False}

    def get_action_spec(self) -> Any:
        return {"action": RAW}

    def get_observation_spec(self) -> Any:
        return {"agentview": IMAGE_RGB, "wrist": IMAGE_RGB, "state": RAW, "language": LANGUAGE}


def through_the_harness(
    policy: MMEPolicy, benchmarks: list[Scripted], **options: Any
) -> MMEVLAModelServer:
    """Run all of them at once, each on a connection of its own, and return the server."""
    server = MMEVLAModelServer(policy, **options)

    async def one(url: str, benchmark: Scripted) -> None:
        async with Connection(url) as connection:
            await SyncEpisodeRunner().run_episode(benchmark, {"name": "touch"}, connection)

    async def all_of_them(url: str) -> None:
        await asyncio.gather(*(one(url, benchmark) for benchmark in benchmarks))

    with serve_background(server) as handle:
        asyncio.run(all_of_them(handle.url))
    return server


def in_process(policy: MMEPolicy, numbers: list[int]) -> np.ndarray:
    """Actions [n, STEPS, 8] of the same episodes, acting together."""
    worlds = [Scripted(number) for number in numbers]
    episodes = [policy.start_episode(f"touch square {number}", seed=42) for number in numbers]
    observed = [[world.reset(None)] for world in worlds]
    for episode, world in zip(episodes, worlds, strict=True):
        if world.video:
            episode.add_frames(np.stack(world.video), is_demo=True)
    while len(worlds[0].taken) < STEPS:
        for episode, frames in zip(episodes, observed, strict=True):
            views = {"front": "agentview", "wrist": "wrist"}
            images = {
                camera: np.stack([f["images"][name] for f in frames])
                for camera, name in views.items()
            }
            episode.observe(images, np.stack([frame["states"] for frame in frames]))
        chunks = policy.act(episodes)[:, :16]
        left = STEPS - len(worlds[0].taken)
        observed = [
            [w.step({"actions": a}).obs for a in c[:left]]
            for w, c in zip(worlds, chunks, strict=True)
        ]
    return np.stack([world.taken for world in worlds])


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return small_policy("tokendrop_expert")


def test_an_episode_has_the_type_of_its_policy(policy: MMEPolicy) -> None:
    benchmark = Scripted(2)
    server = through_the_harness(policy, [benchmark])
    np.testing.assert_array_equal(np.stack(benchmark.taken), in_process(policy, [2])[0])
    assert server.sessions == {}


def test_sessions_act_in_one_batch_and_stay_apart(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []
    act = policy.act

    def counted(episodes: Any, steps: int | None = None) -> np.ndarray:
        sizes.append(len(episodes))
        return act(episodes, steps)

    monkeypatch.setattr(policy, "act", counted)
    benchmarks = [Scripted(number) for number in (0, 1, 3)]
    through_the_harness(policy, benchmarks, max_wait_time=0.5)
    assert max(sizes) > 1 and sum(sizes) == 9
    actions = np.stack([benchmark.taken for benchmark in benchmarks])
    expected = in_process(policy, [0, 1, 3])
    np.testing.assert_allclose(actions, expected, atol=1e-5)
    assert np.abs(expected[0] - expected[1]).max() > 1e-3


class ReturnsState(PredictModelServer):
    """A model server of the harness, of which this library defines the model alone: a chunk of four
    actions that are the state.
    """

    def __init__(self) -> None:
        super().__init__(chunk_size=4)
        self.observed: list[dict[str, Any]] = []

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        self.observed.append(obs)
        return {"actions": np.repeat(obs["states"][None], 4, axis=0)}

    def get_action_spec(self) -> Any:
        return {}

    def get_observation_spec(self) -> Any:
        return {}


@pytest.mark.slow  # waits until the server has said nothing
def test_a_model_server_of_the_harness_is_recognised_and_acts_as_a_remote_policy() -> None:
    states = np.random.default_rng(0).uniform(-1, 1, (10, 8)).astype(np.float32)
    images = np.random.default_rng(1).integers(0, 255, (10, 16, 16, 3), np.uint8)
    views = {"front": images, "wrist": images}
    model = ReturnsState()
    with serve_background(model) as handle:
        remote = RemotePolicy(ServerChoice(handle.url), ROBOMME_JOINT)
        episode = remote.start_episode("touch the square")
        episode.observe({name: view[:6] for name, view in views.items()}, states[:6], DEMO)
        actions = [remote.act(episode)[0]]
        for step in range(6, 10):
            episode.observe({name: view[[step]] for name, view in views.items()}, states[[step]])
            actions.append(remote.act(episode)[0])
        remote.close()
    assert remote.protocol.name == "harness" and episode.failure is None
    # Their server cuts the chunk: four actions from one observation.
    assert np.array_equal(actions, states[[5, 5, 5, 5, 9]])
    first, second = model.observed
    assert first["task_description"] == "touch the square"
    assert np.array_equal(first["images"]["agentview"], images[5])
    assert np.array_equal(np.stack(first["video_history"]), images[:5])
    assert "video_history" not in second


def test_an_observation_without_images_ends_its_episode_alone(policy: MMEPolicy) -> None:
    failing = Scripted(1, fails_at=4)
    with pytest.raises(ModelActError, match="lacks agentview, wrist, states"):
        through_the_harness(policy, [failing])


def test_a_state_that_cannot_be_read_ends_its_episode_alone(policy: MMEPolicy) -> None:
    broken, sound = Scripted(0), Scripted(1)
    server = MMEVLAModelServer(policy)
    contexts: list[Any] = []
    observations = []
    for number, benchmark in enumerate((broken, sound)):
        context = SimpleNamespace(session_id=str(number))
        running = harness.Running(policy.start_episode("", seed=42))
        server.sessions[context.session_id] = running
        observation = benchmark.observation()
        if benchmark is broken:
            observation["states"][:] = np.nan
        images = {
            "front": observation["images"]["agentview"],
            "wrist": observation["images"]["wrist"],
        }
        running.images.append(images)
        running.states.append(observation["states"])
        contexts.append(context)
        observations.append(observation)
    failed, answered = server.predict_batch(observations, contexts)
    with pytest.raises(UserError, match="states must be finite"):
        server._normalize_result(failed, contexts[0])
    assert np.isfinite(answered["actions"]).all()


def test_frames_that_cannot_be_read_are_not_read_again(policy: MMEPolicy) -> None:
    server = MMEVLAModelServer(policy)
    running = harness.Running(policy.start_episode("", seed=42))
    server.sessions["one"] = running
    context: Any = SimpleNamespace(session_id="one")
    words = {"task_description": "touch"}
    for side in (256, 128):
        image = np.zeros((side, side, 3), np.uint8)
        running.images.append({"front": image, "wrist": image})
        running.states.append(np.zeros(8, np.float32))
    with pytest.raises(ValueError, match="same shape"):
        server._caught_up(words, context)

    running.images.append({"front": image, "wrist": image})
    running.states.append(np.zeros(8, np.float32))
    assert server._caught_up(words, context) is running.episode


def test_no_page_of_a_browser_is_served_and_no_message_above_the_limit(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(harness_serve, "ws_serve", harness.serve_websockets)
    monkeypatch.setattr(harness, "Limits", lambda: Limits(message_mib=1))
    with serve_background(MMEVLAModelServer(policy)) as handle:
        with pytest.raises(InvalidStatus, match="403"):
            connect(handle.url, origin=Origin("http://page.example"))
        with connect(handle.url, compression=None) as client:
            client.send(b"0" * 2**21)
            with pytest.raises(ConnectionClosedError, match="1009"):
                client.recv()


def test_it_asks_for_what_the_policy_reads() -> None:
    server = MMEVLAModelServer(small_policy("groundsg"), execute=8)
    expected = {
        "send_state": True,
        "send_video_history": True,
        "send_wrist_image": True,
        "action_space": "joint_angle",
        "send_subgoal": True,
        "subgoal_mode": "grounded",
    }
    assert server.get_observation_params() == expected
    assert set(server.get_observation_spec()) == {
        "agentview",
        "wrist",
        "state",
        "language",
        "subgoal",
    }
    assert server.chunk_size == 8


def test_a_robot_that_moves_by_waypoints_is_refused() -> None:
    with pytest.raises(UserError, match="its action space is 'waypoint'"):
        MMEVLAModelServer(small_policy("pi05", embodiment="robomme_waypoint"))


@pytest.mark.parametrize(
    ("words", "address", "warned"),
    [
        ((), ("127.0.0.1", 8000), False),
        (("--port=1",), ("127.0.0.1", 1), False),
        (("--address=:2",), ("127.0.0.1", 2), False),
        (("--host=0.0.0.0",), ("0.0.0.0", 8000), True),
        (("--address=0.0.0.0:3",), ("0.0.0.0", 3), True),
        (("--config=FILE",), ("0.0.0.0", 4), True),
    ],
)
def test_the_server_listens_on_this_machine_alone_by_default(
    words: tuple[str, ...],
    address: tuple[str, int],
    warned: bool,
    policy: MMEPolicy,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    addresses = []
    monkeypatch.setattr(
        harness_serve, "serve", lambda server, host, port: addresses.append((host, port))
    )
    monkeypatch.setattr(harness_serve, "ws_serve", harness_serve.ws_serve)  # put back at the end
    policy.save_pretrained(tmp_path / "checkpoint")
    (tmp_path / "server.yaml").write_text("host: 0.0.0.0\nport: 4\n")
    words = tuple(word.replace("FILE", str(tmp_path / "server.yaml")) for word in words)
    monkeypatch.setattr(
        sys, "argv", ["vla_eval", *words, f"--args.checkpoint={tmp_path / 'checkpoint'}"]
    )
    main()
    assert addresses == [address]
    assert ("every client that reaches this port" in caplog.text) == warned
