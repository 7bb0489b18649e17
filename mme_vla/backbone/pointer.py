"""Pointing at what a tower has located: the point of a choice as a mixture of objects' places."""

import math

import torch
from torch import Tensor, nn

from mme_vla.backbone.tower import WAVES, located, place_waves

ABSENT = 1e-4  # presence that is added to every one
UNLIKELY = 1e-3  # share that every class has in what is selected


class Pointer(nn.Module):
    """Weighs objects that tokens of `PlaceTower` show, with an action token's query.

    Every class of every token is a component of the mixture. An action token weighs the queries of the goal, whose
    classes are then likely, and places. So what to point at is learned once for all classes and places, where
    regression learns it for each place anew, and the most probable object is taken where regression takes the middle of
    several.

    Args:
        action_width: of an action token. width: of queries and keys. goals: q, queries that select classes by the goal.
    """

    def __init__(self, action_width: int, width: int, goals: int) -> None:
        super().__init__()
        self.query = nn.Linear(action_width, width)
        self.goals = nn.Linear(action_width, goals)
        self.near = nn.Linear(WAVES**2, width, bias=False)
        self.visible = nn.Parameter(torch.ones(()))
        self.point = nn.Linear(2, 2)
        with torch.no_grad():
            self.point.weight.copy_(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))  # a point is row and column
            self.point.bias.zero_()

    def forward(self, actions: Tensor, tokens: Tensor, selected: Tensor) -> Tensor:
        """Logits of m = n·K components, then their points, [b, h, 3·m].

        Args:
            actions: [b, h, d]. tokens: of the tower, [b, n, ≥ 20·K]. selected: share of each class in what the goal
                selects, [b, q, K].
        """
        presence, where = located(tokens.to(self.near.weight.dtype))
        keys = self.near(place_waves(where)).flatten(1, 2)
        logits = self.query(actions) @ keys.transpose(1, 2) / math.sqrt(keys.shape[-1])
        classes = (self.goals(actions).softmax(-1) @ selected + UNLIKELY).log()  # b h K
        logits = logits + classes.repeat(1, 1, tokens.shape[1])
        logits = logits + (self.visible * (presence + ABSENT).log()).flatten(1)[:, None]
        points = self.point(where).flatten(1)[:, None]
        return torch.cat([logits, points.expand(-1, actions.shape[1], -1)], -1)
