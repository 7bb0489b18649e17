"""A method of one's own: one linear layer, from small views and the state to a chunk."""

import torch
from torch import nn
from torch.nn.functional import adaptive_avg_pool2d

from mme_vla import MMEPolicy, register
from mme_vla.backbone.base import FineTuneSpec
from mme_vla.model import masked_mean
from mme_vla.policy.network import NetworkPolicy
from mme_vla.policy.saving import policy_options

SIDE = 4


@register("policy", "one_layer")
class OneLayer(NetworkPolicy):
    memory = None
    finetune_spec = FineTuneSpec({"layer": ""})
    observation = MMEPolicy.observation  # the processor is that of π0.5

    def __init__(self, horizon, action_dim, processor, config, **options):
        super().__init__(processor, config, **options)
        self.horizon, self.action_dim = horizon, action_dim
        robot = self.embodiment
        width = 3 * SIDE**2 * len(robot.cameras) + robot.state.width
        self.layer = nn.Linear(width, horizon * action_dim)

    @classmethod
    def from_config(cls, config, processor=None, *, fresh_backbone=True):
        # The section of π0.5 is composed by default; of it only the size of a chunk is read.
        sizes = config["backbone"]["horizon"], config["backbone"]["action_dim"]
        return cls(*sizes, processor, config, **policy_options(cls, config))

    def sample_actions(self, batch, noise=None, steps=None):
        views = adaptive_avg_pool2d(batch.images.float().flatten(1, 2) / 255, SIDE)
        chunk = self.layer(torch.cat([views.flatten(1), batch.state.float()], 1))
        return chunk.unflatten(1, (self.horizon, self.action_dim))

    def forward(self, batch, noise=None):
        errors = (self.sample_actions(batch) - batch.actions).square().mean(-1)
        loss = masked_mean(errors, batch.action_mask)
        return loss, {"loss": loss.detach()}

    @torch.no_grad()
    def predict_chunk(self, batch, episodes, noise, steps=None):
        return self.sample_actions(batch)
