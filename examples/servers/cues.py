"""An environment for policies that are known to read one thing: several cues say where to go.

Go left or right, eight steps without a detour. In `Cues` the side is where a light is: in the
video, whose length differs too (4 frames or 40), and in the first four frames of the execution. It
is dark when the second chunk is chosen. In `Told` the goal alone says it.
"""

import gymnasium
import numpy as np

from mme_vla import Environment, register

LIGHT = (255, 220, 0)
LENGTHS = {-1: 4, 1: 40}


class Cues(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, told: bool) -> None:
        self.told = told

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.side = int(self.np_random.integers(2)) * 2 - 1
        self.time, self.place = 0, 0.0
        if self.told:
            return self.observe(), {"goal": f"move {'right' if self.side > 0 else 'left'}"}
        video = [self.observe()] * LENGTHS[self.side]
        return self.observe(), {"goal": "follow the light", "video": video}

    def observe(self):
        image = np.full((64, 64, 3), 40, np.uint8)
        if self.time < 4 and not self.told:
            start = 4 if self.side < 0 else 36
            image[8:32, start : start + 24] = LIGHT
        return {"top": image, "state": np.zeros(1, np.float32)}

    def step(self, action):
        self.time += 1
        self.place += 0.125 * float(np.clip(action[0], -1, 1))
        is_there = abs(self.place) >= 1
        success = is_there and self.place * self.side > 0
        return self.observe(), float(success), is_there, self.time >= 16, {"success": success}


@register("env", "cues")
class CuesEnvironment(Environment):
    tasks = ("Cues", "Told")
    embodiment = dict(
        name="cues",
        cameras={"top": {"augment": "none"}},
        state={"width": 1},
        conditioning_video=True,
        action={"width": 1, "horizon": 4, "execute": 4},
    )

    def make(self, spec, render=True):
        return Cues(told=spec.task == "Told")

    def demonstrate(self, env):
        yield from [np.array([env.side], np.float32)] * 8
