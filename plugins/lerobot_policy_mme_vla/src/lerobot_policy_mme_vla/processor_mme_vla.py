"""LeRobot's pipelines around the policy: they batch and move, all else is the policy's own
processor's.
"""

from typing import Any

from lerobot.processor import make_default_pre_post_processors

from lerobot_policy_mme_vla.configuration_mme_vla import MMEVLAConfig


def make_mme_vla_pre_post_processors(
    config: MMEVLAConfig, dataset_stats: Any = None
) -> tuple[Any, Any]:
    """The pipelines before and after the policy.

    LeRobot's usual steps, which its commands set by name in a saved pipeline; their normalisation
    is the identity.
    """
    pipelines: tuple[Any, Any] = make_default_pre_post_processors(config, dataset_stats)
    return pipelines
