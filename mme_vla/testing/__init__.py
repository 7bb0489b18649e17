"""For tests of one's own parts: small policies and batches, and checks of the contracts a part
signs.

The library holds its own memories, integrations, backbones and tasks to the same checks.
"""

from mme_vla.testing.check_backbone import check_backbone
from mme_vla.testing.check_integration import check_integration
from mme_vla.testing.check_memory import check_memory
from mme_vla.testing.check_task import check_task
from mme_vla.testing.small import moving_frames, random_batch, small_policy

__all__ = [
    "check_backbone",
    "check_integration",
    "check_memory",
    "check_task",
    "moving_frames",
    "random_batch",
    "small_policy",
]
