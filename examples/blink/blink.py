"""An environment of one's own: a light blinks, goes out, and the arm moves to where it was."""

import gymnasium
import numpy as np

from mme_vla import Environment, Fact, register


class Blink(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.side, self.time, self.arm = int(self.np_random.integers(2)) * 2 - 1, 0, 0.0
        video = [self.observe(light=True)] * 4
        return self.observe(), {"goal": "move to where the light was", "video": video}

    def observe(self, light=False):
        image = np.full((64, 64, 3), 40, np.uint8)
        image[48:56, int(28 + 24 * self.arm) : int(36 + 24 * self.arm)] = 200
        if light:
            image[8:24, 8 + 16 * (self.side + 1) : 24 + 16 * (self.side + 1)] = (255, 220, 0)
        return {"top": image, "state": np.array([self.arm], np.float32)}

    def step(self, action):
        self.time += 1
        self.arm = float(np.clip(self.arm + 0.25 * np.clip(action[0], -1, 1), -1, 1))
        success, over = self.arm * self.side >= 1, abs(self.arm) >= 1
        return self.observe(), float(success), over, self.time >= 20, {"success": success}


@register("env", "blink")
class BlinkEnvironment(Environment):
    tasks = ("Blink",)
    suites = {"Recall": ("Blink",)}
    embodiment = dict(
        name="blink",
        cameras={"top": {"augment": "none"}},
        state={"width": 1},
        conditioning_video=True,
        action={"width": 1, "horizon": 4, "execute": 4},
    )

    def make(self, spec, render=True):
        return Blink()

    def demonstrate(self, env):
        yield from [np.array([env.side], np.float32)] * 4

    def facts(self, env):
        return [Fact("light", "left" if env.side < 0 else "right", frames=(0, 3), needed=(4,))]

    def choices(self, env):
        return {"move left": [np.array([-1.0])] * 4, "move right": [np.array([1.0])] * 4}
