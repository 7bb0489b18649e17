"""ManiSkill's own PickCube-v1 as an environment: its scene, its success, and a demonstrator that
moves the hand.
"""

from functools import cache

import gymnasium
import mani_skill.envs  # noqa: F401
import numpy as np

from mme_vla import Environment, register

SCALE = 0.1  # metres that an action of 1 moves the hand


class PickCube(gymnasium.Wrapper):
    """Images and state by the names of the embodiment. Actions: a displacement of the hand [3], and
    the gripper.
    """

    def __init__(self, render):
        sensors = {"sensor_configs": {"width": 64, "height": 64}} if render else {}
        mode = "rgb" if render else "state_dict"
        super().__init__(
            gymnasium.make(
                "PickCube-v1",
                obs_mode=mode,
                control_mode="pd_ee_delta_pos",
                sim_backend="physx_cpu",
                render_backend="cpu" if render else "none",
                max_episode_steps=100,
                **sensors,
            )
        )
        self.rendered = render

    def observe(self, observation):
        scene = self.unwrapped
        hand, cube, goal = (
            part.pose.p[0].cpu().numpy() for part in (scene.agent.tcp, scene.cube, scene.goal_site)
        )
        self.hand, self.cube, self.goal = hand, cube, goal
        finger = scene.agent.robot.get_qpos()[0, -1:].cpu().numpy()
        image = np.zeros((64, 64, 3), np.uint8)
        if self.rendered:
            image = observation["sensor_data"]["base_camera"]["rgb"][0].cpu().numpy()
        return {
            "base": image,
            "state": np.concatenate([finger, cube - hand, goal - cube]).astype(np.float32),
        }

    def close(self):
        """Keep the scene: a new one compiles its shaders anew."""

    def reset(self, *, seed=None, options=None):
        observation, _ = self.env.reset(seed=seed, options=options)
        return self.observe(observation), {
            "goal": "pick up the cube and bring it to the green point"
        }

    def step(self, action):
        action = np.asarray(action, np.float32)
        observation, reward, _, truncated, info = self.env.step(action)
        success = bool(info["success"])
        return (
            self.observe(observation),
            float(reward),
            success,
            bool(truncated),
            {"success": success},
        )


scene = cache(PickCube)


@register("env", "pick_cube")
class PickCubeEnvironment(Environment):
    tasks = ("PickCube-v1",)
    embodiment = dict(name="pick_cube", cameras={"base": {"augment": "none"}}, state={"width": 7},
                      action={"width": 4, "horizon": 4, "execute": 4})  # fmt: skip

    def make(self, spec, render=True):
        return scene(render)

    def demonstrate(self, env):
        """Above the cube, down, close, to the goal."""
        above = np.array([0, 0, 0.06])
        stages = (
            (lambda: env.cube + above, 1),
            (lambda: env.cube, 1),
            (None, -1),
            (lambda: env.goal, -1),
        )
        for target, gripper in stages:
            for _ in range(8 if target is None else 30):
                offset = (
                    np.zeros(3)
                    if target is None
                    else target() - (env.cube if gripper < 0 else env.hand)
                )
                if target is not None and np.abs(offset).max() < 0.005 and gripper > 0:
                    break
                yield np.append(np.clip(offset / SCALE, -1, 1), gripper).astype(np.float32)
        while True:
            yield np.array([0, 0, 0, -1], np.float32)
