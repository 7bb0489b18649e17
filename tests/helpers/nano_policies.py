"""Nano policies and a demonstration with random images for them."""

import numpy as np

from mme_vla import build_policy
from mme_vla.data.waypoints import Motions
from mme_vla.envs.facts import Fact
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.policy.mme import MMEPolicy

EVERY_EIGHTH = {"budget": 256, "grid": 8, "every": 8}


def nano(model: str = "framesamp_modul", **others: object) -> MMEPolicy:
    memory = {"memory": EVERY_EIGHTH} if model.startswith("framesamp") else {}
    words = {
        "backbone": "nano",
        "embodiment": "robomme_waypoint_front",
        "policy": {"augment": False},
    }
    return build_policy(model, **words, **memory, **others)


def demonstration(
    frames: tuple[int, ...] = (0, 15, 39, 47, 63, 66, 79, 95, 119, 120, 151, 155),
) -> Demonstration:
    rng = np.random.default_rng(0)
    images = {frame: rng.integers(0, 256, (256, 256, 3), dtype=np.uint8) for frame in frames}
    targets = rng.uniform(-0.2, 0.2, (3, 7)).astype(np.float32)
    motions = Motions(np.array([66, 120, 155]), targets)
    states = rng.uniform(-1, 1, (180, 8)).astype(np.float32)
    subgoals = {"simple": ["pick it up"] * 3, "grounded": ["pick it up at <1, 2>"] * 3}
    goal = "watch the video carefully, then pick up the container hiding the green cube"
    return Demonstration(
        "VideoUnmask",
        3,
        "easy",
        goal,
        180,
        66,
        states,
        motions,
        {"front": images},
        boundaries=np.array([0]),
        subgoals=subgoals,
        facts=[Fact("cover 0", "green: container_1", (0, 31), (66,))],
    )
