"""Twins for `probe twins`: the scene of blink.py, and the same with the light on the other side."""

from blink import Blink, BlinkEnvironment

from mme_vla import Candidates, register


class TwinBlink(Blink):
    flipped = False

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        if self.flipped:
            self.side = -self.side
            info["video"] = [self.observe(light=True)] * 4
        return observation, info


@register("env", "blink_twins")
class BlinkTwins(BlinkEnvironment):
    def make(self, spec, render=True):
        env = TwinBlink()
        env.flipped = spec.row is not None
        return env

    def twin(self, spec):
        return {"flipped": "light"}

    def candidates(self, env):
        return Candidates([[-1], [1]], correct=[int(env.side > 0)])

    def tool(self, env):
        return [env.arm]
