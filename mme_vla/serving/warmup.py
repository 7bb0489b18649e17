"""One pretended episode before the first client, so that no client pays for what happens only once."""

import numpy as np

from mme_vla.embodiment import Embodiment, Option
from mme_vla.embodiment.robomme import SIDE
from mme_vla.policy.base import Policy
from mme_vla.serving.settings import ServeSettings


def warm_up(policy: Policy, settings: ServeSettings) -> None:
    """Encode a piece of video and choose chunks, alone and as a pair; nothing of it is kept."""
    robot, count = policy.embodiment, settings.encode_chunk
    episodes = [policy.start_episode("warm up", seed=settings.seed) for _ in range(min(2, settings.max_batch))]
    for episode in episodes:
        episode.subgoal, episode.options = "warm up", (Option("a", "warm up"),)
        episode.observe(_nothing(robot, count), np.zeros((count, robot.state.width), np.float32))
    policy.act(episodes[:1], settings.flow_steps)
    policy.act(episodes, settings.flow_steps)


def _nothing(robot: Embodiment, count: int) -> dict[str, np.ndarray]:
    """Black pictures of every camera, and a wall at no distance where it reads depth."""
    seen: dict[str, np.ndarray] = {}
    for camera in robot.cameras:
        seen[camera.name] = np.zeros((count, SIDE, SIDE, 3), np.uint8)
        beside = (np.zeros((count, SIDE, SIDE, 1), np.float32), np.tile(np.eye(3, 4, dtype=np.float32), (count, 1, 1)))
        seen |= dict(zip(camera.readings, beside, strict=False))
    return seen
