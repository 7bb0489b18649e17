"""One pretended episode before the first client, so that no client pays for what happens only once."""

import numpy as np

from mme_vla.embodiment import Option
from mme_vla.embodiment.robomme import SIDE
from mme_vla.policy.base import Policy
from mme_vla.serving.settings import ServeSettings


def warm_up(policy: Policy, settings: ServeSettings) -> None:
    """Encode a piece of video and choose chunks, alone and as a pair; nothing of it is kept."""
    frames = np.zeros((settings.encode_chunk, SIDE, SIDE, 3), np.uint8)
    episodes = [policy.start_episode("warm up", seed=settings.seed) for _ in range(min(2, settings.max_batch))]
    for episode in episodes:
        episode.subgoal, episode.options = "warm up", (Option("a", "warm up"),)
        robot = policy.embodiment
        episode.remember(frames, states=np.zeros((len(frames), robot.state.width), np.float32))
        view = dict.fromkeys(robot.camera_names, frames[0])
        episode.look(view, np.zeros(robot.state.width, np.float32))
    policy.act(episodes[:1], settings.flow_steps)
    policy.act(episodes, settings.flow_steps)
