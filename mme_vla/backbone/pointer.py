"""Pointing at what a tower has located: the point of a choice as a mixture of objects' places."""

import math

import torch
from torch import Tensor, nn

from mme_vla.backbone.tower import FACTORS, WAVES, by_class, located, place_waves
from mme_vla.types import HistoryTokens

ABSENT = 1e-4  # presence that is added to every one
UNLIKELY = 1e-3  # share that every class has in what is selected
SEEN = 0.5  # objects of a class that a history must have shown for their places to be a target
FRESH_SHARPNESS = 0.5  # factor of the density at first: what is recalled counts little before it is learned


class Pointer(nn.Module):
    """Weighs objects that tokens of `PlaceTower` show, with an action token's query.

    Every class of every token is a component of the mixture. An action token weighs the queries of the goal, whose
    classes are then likely, and places. So what to point at is learned once for all classes and places, where
    regression learns it for each place anew, and the most probable object is taken where regression takes the middle of
    several.

    It also recalls: from what an action token has read of memory it says, for each query of the goal, where the objects
    of its classes were seen. `recall_loss` teaches that in every decision, also in those that do not depend on it, and
    an object near a recalled place is likelier.

    Args:
        action_width: of an action token. width: of queries and keys. goals: q, queries that select classes by the goal.
    """

    def __init__(self, action_width: int, width: int, goals: int) -> None:
        super().__init__()
        self.query = nn.Linear(action_width, width)
        self.goals = nn.Linear(action_width, goals)
        self.near = nn.Linear(WAVES**2, width, bias=False)
        self.visible = nn.Parameter(torch.ones(()))
        self.recall = nn.Linear(action_width, goals * WAVES**2)
        self.counts = nn.Linear(action_width, goals + 1)  # which recalled places count; the last: none
        self.sharpness = nn.Parameter(torch.tensor(FRESH_SHARPNESS))
        self.point = nn.Linear(2, 2)
        with torch.no_grad():
            self.point.weight.copy_(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))  # a point is row and column
            self.point.bias.zero_()

    def forward(self, actions: Tensor, tokens: Tensor, selected: Tensor, recalls: bool = False) -> Tensor:
        """Logits of m = n·K components, then their points, [b, h, 3·m].

        Args:
            actions: [b, h, d]. tokens: of the tower, [b, n, ≥ 20·K]. selected: share of each class in what the goal
                selects, [b, q, K].
            recalls: whether there is a memory to recall from.
        """
        presence, where = located(tokens.to(self.near.weight.dtype))
        keys = self.near(place_waves(where)).flatten(1, 2)
        logits = self.query(actions) @ keys.transpose(1, 2) / math.sqrt(keys.shape[-1])
        classes = (self.goals(actions).softmax(-1) @ selected + UNLIKELY).log()  # b h K
        logits = logits + classes.repeat(1, 1, tokens.shape[1])
        if recalls:
            logits = logits + self.near_recalled(actions, where)
        logits = logits + (self.visible * (presence + ABSENT).log()).flatten(1)[:, None]
        points = self.point(where).flatten(1)[:, None]
        return torch.cat([logits, points.expand(-1, actions.shape[1], -1)], -1)

    def near_recalled(self, actions: Tensor, where: Tensor) -> Tensor:
        """How likely recalled places make places [b, n, K, 2]: [b, h, n·K].

        Recalled waves are the coefficients of a cosine series, whose value at a place is the density of objects there.
        """
        counts = self.counts(actions).softmax(-1)[..., :-1]
        recalled = torch.einsum("bhq,bhqw->bhw", counts, self.recalled(actions))
        axis = torch.tensor([1.0, *[2.0] * (WAVES - 1)], device=where.device, dtype=where.dtype)
        series = place_waves(where) * (axis[:, None] * axis).flatten()
        return self.sharpness * torch.einsum("bhw,bnkw->bhnk", recalled, series).flatten(2)

    def recalled(self, actions: Tensor) -> Tensor:
        """Waves [b, h, q, 16] of where the objects that each query selects were seen, as action tokens say."""
        waves: Tensor = self.recall(actions).unflatten(-1, (-1, WAVES**2))
        return waves

    def recall_loss(self, actions: Tensor, history: HistoryTokens, selected: Tensor) -> Tensor:
        """Mean squared error [b] of recalled waves; 0 for what the history never showed.

        The target of a query is the mean over all its objects in all tokens of the history. No gradient reaches the
        selection through it.

        Args:
            actions: [b, h, d]. history: of the tower's tokens [b, n, ≥ 20·K], as memory selected them.
            selected: share of each class in what the goal selects [b, q, K].
        """
        with torch.no_grad():
            waves = by_class(history.features.float())[..., 4:] / FACTORS[-1]  # b n K 16
            summed = torch.einsum("bqk,bnkw,bn->bqw", selected.float(), waves, history.mask.float())
            shown = summed[..., :1]  # the first wave counts objects
            # A token of a whole frame is the mean of the tower's 64.
            target, known = summed / shown.clamp(min=1e-6), shown[..., 0] > SEEN / 64
        error = (self.recalled(actions).float() - target[:, None]).square().mean((1, 3))
        return (error * known).sum(1) / known.sum(1).clamp(min=1)
