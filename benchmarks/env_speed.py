"""Steps per second of the rendering environments, beside ManiSkill's PickCube-v1 with the same two
cameras.

    python benchmarks/env_speed.py [TASK ...] [--steps 40] [--workers 1 2]

Each task and PickCube take turns in one process, so that both see the same machine; the ratio is
what counts. Then where the time of a step goes, and episodes in worker processes.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import gymnasium
import mani_skill.envs  # noqa: F401  (registers PickCube-v1)
import numpy as np
from mani_skill.sensors.camera import CameraConfig
from mani_skill.utils import sapien_utils

from mme_vla.envs import make_env, make_vec_env, observations
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.envs.rendering import render_backend

HOLD = np.array([0, 0, 0, -np.pi / 2, 0, np.pi / 2, np.pi / 4, 1], np.float32)


def pick_cube() -> Callable[[], object]:
    """One step of PickCube-v1 with a 256 × 256 front and wrist camera."""
    front = CameraConfig(
        "base_camera",
        sapien_utils.look_at([0.3, 0, 0.4], [0, 0, -0.2]),
        256,
        256,
        np.pi / 2,
        0.01,
        100,
    )
    env = gymnasium.make(
        "PickCube-v1",
        obs_mode="rgb",
        render_backend=render_backend(),
        sim_backend="physx_cpu",
        robot_uids="panda_wristcam",
        control_mode="pd_joint_pos",
        sensor_configs={
            "base_camera": {"width": 256, "height": 256, "pose": front.pose, "fov": front.fov},
            "hand_camera": {"width": 256, "height": 256},
        },
    )
    env.reset(seed=0)
    return lambda: env.step(HOLD)


def library_env(task: str) -> tuple[Any, Callable[[], object]]:
    """A task's environment, and one step of it; no image of its conditioning video is rendered."""
    env = make_env(task, seed=1, difficulty="hard", max_steps=100_000)
    env.render_request = observations.RenderRequest({}, now=(), grounded=False)
    env.reset()
    env.render_request = None
    action = HOLD[:7] if env.action_space.shape == (7,) else HOLD
    return env, lambda: env.step(action)


class Parts:
    """Times the parts of an environment's step: what the simulator does, and what is left to us."""

    def __init__(self, env: Any) -> None:
        self.seconds = {"physics": 0.0, "rendering": 0.0, "waiting for images": 0.0}
        scene = env.task.scene
        scene.step = self._timed("physics", scene.step)
        scene.update_render = self._timed("rendering", scene.update_render)
        for sensor in scene.sensors.values():
            sensor.capture = self._timed("rendering", sensor.capture)
        # Rendering continues in the background until an image is read: this is the other part of
        # its time.
        observations.read_images = self._timed("waiting for images", observations.read_images)

    def _timed(self, part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            begun = time.perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                self.seconds[part] += time.perf_counter() - begun

        return timed


def rate(step: Callable[[], object], steps: int) -> float:
    """Steps per second."""
    start = time.perf_counter()
    for _ in range(steps):
        step()
    return steps / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", default=list(TASK_NAMES))
    parser.add_argument(
        "--steps", type=int, default=40, help="steps of each before the other has its turn"
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2])
    args = parser.parse_args()
    reference = pick_cube()
    rate(reference, 5)
    print("| task | steps/s | PickCube-v1, same run | ratio |\n|---|---:|---:|---:|")
    for task in args.tasks:
        env, step = library_env(task)
        rate(step, 3)
        pairs = [(rate(step, args.steps), rate(reference, args.steps)) for _ in range(args.rounds)]
        target, source = (float(np.median(values)) for values in zip(*pairs, strict=True))
        env.close()
        print(
            f"| {task} | {target:.2f} | {source:.2f} |"
            f" {np.median([a / b for a, b in pairs]):.2f} |",
            flush=True,
        )
    where(args.tasks[0], args.steps)
    for workers in args.workers:
        print(
            f"{workers} workers: {workers_rate(workers, args.steps):.2f} steps/s together",
            flush=True,
        )


def where(task: str, steps: int) -> None:
    """Print where the time of a step goes."""
    env, step = library_env(task)
    rate(step, 3)
    parts = Parts(env)
    total = 1000 / rate(step, steps)
    milliseconds = {name: 1000 * seconds / steps for name, seconds in parts.seconds.items()}
    milliseconds["all else"] = total - sum(milliseconds.values())
    env.close()
    shares = ", ".join(
        f"{name} {value:.1f} ms ({100 * value / total:.0f} %)"
        for name, value in milliseconds.items()
    )
    print(f"\na step of {task}: {total:.1f} ms: {shares}", flush=True)


def workers_rate(workers: int, steps: int) -> float:
    """Steps per second of PickXtimes in worker processes, each stepped as soon as it is ready."""
    with make_vec_env(
        "PickXtimes", episodes=range(workers), workers=workers, max_steps=100_000
    ) as envs:
        for worker in range(envs.workers):
            envs.start_next(worker)
        ready = 0
        while ready < workers:
            replies = envs.recv()
            ready += len(replies)
        start, done = time.perf_counter(), 0
        for worker in range(workers):
            envs.send(worker, HOLD)
        while done < steps * workers:
            for reply in envs.recv():
                done += 1
                envs.send(reply.worker, HOLD)
        return done / (time.perf_counter() - start)


if __name__ == "__main__":
    main()
