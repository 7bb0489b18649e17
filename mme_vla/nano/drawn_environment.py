"""Environments that draw only what a small policy looks at: every so-many-th frame, and the newest of each call."""

from typing import Any

import numpy as np

from mme_vla.envs.make import make_env
from mme_vla.nano.demonstrations import draw

BLANK = np.zeros((256, 256, 3), np.uint8)


def make_drawn_env(task: str, split: str, episode: int, max_steps: int, every: int, **options: Any) -> Any:
    """A waypoint environment of which the front camera shows frames 0, k·every − 1 and the newest; others are black."""
    env: Any = make_env(task, split, episode, "waypoint", max_steps=max_steps, **options)
    observer, whole = env._observer, env._observer.frame
    seen = 0

    def frame(info: dict[str, Any]) -> dict[str, Any]:
        nonlocal seen
        observer.render = False
        found = whole(info)
        observer.render = True
        wanted = seen == 0 or (seen + 1) % every == 0
        seen += 1
        return {**found, "front_rgb": draw(env.task, ["front"])[0][1] if wanted else BLANK, "wrist_rgb": BLANK}

    observer.frame = frame
    reset, step = env.reset, env.step

    def newest(answer: tuple) -> tuple:
        if answer[0]:
            answer[0]["front_rgb_list"][-1] = draw(env.task, ["front"])[0][1]
        return answer

    def begin(**given: Any) -> tuple:
        nonlocal seen
        seen = 0
        return newest(reset(**given))

    env._render = False  # texts with pixels would need pictures
    env.reset, env.step = begin, lambda action: newest(step(action))
    return env
