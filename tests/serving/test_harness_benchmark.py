"""The harness's own RoboMME benchmark, unmodified, over this library's environments: actions are
the policy's own.
"""

import asyncio
from typing import Any

import numpy as np
import pytest

from helpers.plugins import plugin

vla_eval = pytest.importorskip(
    "vla_eval", reason="the harness is not installed: uv sync --inexact --extra harness"
)
pytest.importorskip(
    "mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim"
)
from vla_eval.api import serve_background  # noqa: E402
from vla_eval.benchmarks.robomme.benchmark import RoboMMEBenchmark  # noqa: E402
from vla_eval.connection import Connection  # noqa: E402
from vla_eval.runners.sync_runner import SyncEpisodeRunner  # noqa: E402

from mme_vla.envs import make_env  # noqa: E402
from mme_vla.policy.mme import MMEPolicy  # noqa: E402
from mme_vla.serving.harness import MMEVLAModelServer  # noqa: E402
from mme_vla.testing.small import small_policy  # noqa: E402

TASK, EPISODE, STEPS = "StopCube", 3, 18
"""No video, and two chunks."""


class Noted(RoboMMEBenchmark):
    """Theirs, and the actions it was given."""

    taken: list[np.ndarray]

    def step(self, action: Any) -> Any:
        self.taken.append(np.array(action["actions"], np.float32).reshape(-1))
        return super().step(action)


def through_the_harness(policy: MMEPolicy, benchmark: Noted) -> None:
    async def one(url: str) -> None:
        async with Connection(url) as connection:
            task = {"name": TASK, "env_id": TASK, "episode_idx": EPISODE}
            await SyncEpisodeRunner().run_episode(benchmark, task, connection, max_steps=STEPS)

    with serve_background(MMEVLAModelServer(policy)) as handle:
        asyncio.run(one(handle.url))


def in_process(policy: MMEPolicy) -> np.ndarray:
    """The actions [STEPS, 8] of the same episode without the harness."""
    env, taken = make_env(TASK, "test", EPISODE, max_steps=STEPS), []
    try:
        observed, info = env.reset()
        episode = policy.start_episode(info["task_goal"][0], seed=42)
        frames = [observed]
        while len(taken) < STEPS:
            images = {
                name: np.stack([f[f"{name}_rgb_list"][-1] for f in frames])
                for name in ("front", "wrist")
            }
            arms = [[*f["joint_state_list"][-1], f["gripper_state_list"][-1][0]] for f in frames]
            episode.observe(images, np.array(arms, np.float32))
            chunk = policy.act(episode)[:16][: STEPS - len(taken)]
            taken += list(chunk)
            frames = [env.step(action)[0] for action in chunk]
    finally:
        env.close()
    return np.stack(taken)


@pytest.mark.slow
def test_its_benchmark_runs_on_our_environments_and_takes_the_policys_actions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # the renderer is this library's affair
    monkeypatch.setattr(RoboMMEBenchmark, "_render_env", {})
    policy = small_policy("tokendrop_expert")
    benchmark = Noted(tasks=[TASK], max_steps=STEPS)
    benchmark.taken = []
    with plugin("robomme", "robomme"):
        try:
            through_the_harness(policy, benchmark)
        finally:
            benchmark.cleanup()
    expected = in_process(policy)
    assert len(benchmark.taken) >= STEPS - 1
    np.testing.assert_array_equal(np.stack(benchmark.taken), expected[: len(benchmark.taken)])
