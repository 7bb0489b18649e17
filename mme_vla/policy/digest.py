"""A digest that tells compositions apart."""

from collections.abc import Mapping
from typing import Any

from mme_vla.config.variant import DECISIVE, digest, flat, of_policy
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.embodiment.robomme import embodiment_of


def composition_digest(config: Mapping[str, Any]) -> str:
    """Twelve letters that are equal for two policies exactly if they are composed alike, sizes included.

    Args:
        config: of a policy, as it is saved with the weights. Where its tokenizer lies, what it was trained on and in
            which precision it computes do not count; nor do keys that are not set, so that a later option with an
            empty default changes no digest. The robot counts where it is not RoboMME's Panda in joint space.
    """
    kept = flat({key: config.get(key) for key in (*DECISIVE, "backbone")}) | of_policy(config.get("policy") or {})
    kept = {key: value for key, value in kept.items() if value is not None and key != "processor.tokenizer"}
    robot = embodiment_of(config)
    if robot != ROBOMME_JOINT.with_horizon(robot.action.horizon):  # which configurations did not use to name
        kept |= flat({"embodiment": robot.to_dict()})
    return digest(kept, 12)
