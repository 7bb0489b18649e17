"""Pointing at what a tower has located: the point of a choice as a mixture of objects' places."""

import math

import torch
from torch import Tensor, nn

from mme_vla.extras.nano.tower import FACTORS, WAVES, by_class, located, place_waves
from mme_vla.types import HistoryTokens

ABSENT = 1e-4  # presence that is added to every one
UNLIKELY = 1e-3  # share that every class has in what is selected
MIN_OBJECTS = 0.5  # of a query's classes in a history, for their places to be a target
FRESH_SHARPNESS = (
    0.5  # factor of the density map at first: a map that is not yet learned counts little
)


class Pointer(nn.Module):
    """Weighs objects that tokens of `PlaceTower` show, with an action token's query.

    Every class of every token is a component of the mixture. An action token weighs the queries of
    the goal, whose classes are then likely, and places. So what to point at is learned once for all
    classes and places, where regression learns it for each place anew, and the most probable object
    is taken where regression takes the middle of several.

    With a memory, an action token also predicts a density map for each query of the goal: where the
    past frames that memory selected show objects of its classes. `localization_loss` trains it in
    every decision, also in those that do not depend on it. Objects at places of high density are
    likelier.

    Args:
        action_width: of an action token.
        width: of queries and keys.
        goals: q, queries that select classes by the goal.
    """

    def __init__(self, action_width: int, width: int, goals: int) -> None:
        super().__init__()
        self.query = nn.Linear(action_width, width)
        self.goals = nn.Linear(action_width, goals)
        self.near = nn.Linear(WAVES**2, width, bias=False)
        self.visible = nn.Parameter(torch.ones(()))
        # `recall` and `counts`: names in the shipped checkpoint.
        self.recall = nn.Linear(action_width, goals * WAVES**2)
        # weights of the queries' maps, and of none
        self.counts = nn.Linear(action_width, goals + 1)
        self.sharpness = nn.Parameter(torch.tensor(FRESH_SHARPNESS))
        self.point = nn.Linear(2, 2)
        with torch.no_grad():
            # a point is row and column
            self.point.weight.copy_(torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
            self.point.bias.zero_()

    def forward(
        self, actions: Tensor, tokens: Tensor, selected: Tensor, has_memory: bool = False
    ) -> Tensor:
        """Logits of m = n·K components, then their points, [b, h, 3·m].

        Args:
            actions: [b, h, d].
            tokens: of the tower, [b, n, ≥ 20·K].
            selected: share of each class in what the goal selects, [b, q, K].
            has_memory: whether the action tokens have read a memory.
        """
        presence, where = located(tokens.to(self.near.weight.dtype))
        keys = self.near(place_waves(where)).flatten(1, 2)
        logits = self.query(actions) @ keys.transpose(1, 2) / math.sqrt(keys.shape[-1])
        classes = (self.goals(actions).softmax(-1) @ selected + UNLIKELY).log()  # b h K
        logits = logits + classes.repeat(1, 1, tokens.shape[1])
        if has_memory:
            logits = logits + self.density(actions, where)
        logits = logits + (self.visible * (presence + ABSENT).log()).flatten(1)[:, None]
        points = self.point(where).flatten(1)[:, None]
        return torch.cat([logits, points.expand(-1, actions.shape[1], -1)], -1)

    def density(self, actions: Tensor, where: Tensor) -> Tensor:
        """Density [b, h, n·K] of the maps at places [b, n, K, 2], times `sharpness`.

        A map is a cosine series: its waves are the coefficients.
        """
        weights = self.counts(actions).softmax(-1)[..., :-1]
        waves = torch.einsum("bhq,bhqw->bhw", weights, self.predict_maps(actions))
        axis = torch.tensor([1.0, *[2.0] * (WAVES - 1)], device=where.device, dtype=where.dtype)
        series = place_waves(where) * (axis[:, None] * axis).flatten()
        return self.sharpness * torch.einsum("bhw,bnkw->bhnk", waves, series).flatten(2)

    def predict_maps(self, actions: Tensor) -> Tensor:
        """Waves [b, h, q, 16] of the map of each query."""
        waves: Tensor = self.recall(actions).unflatten(-1, (-1, WAVES**2))
        return waves

    def localization_loss(
        self, actions: Tensor, history: HistoryTokens, selected: Tensor
    ) -> Tensor:
        """Mean squared error [b] of the maps' waves, over the queries whose classes the history
        shows; 0 without any.

        The target of a query is the mean over all its objects in all tokens of the history. It
        passes no gradient.

        Args:
            actions: [b, h, d].
            history: of the tower's tokens [b, n, ≥ 20·K], as memory selected them.
            selected: share of each class in what the goal selects [b, q, K].
        """
        with torch.no_grad():
            waves = by_class(history.features.float())[..., 4:] / FACTORS[-1]  # b n K 16
            summed = torch.einsum("bqk,bnkw,bn->bqw", selected.float(), waves, history.mask.float())
            n_objects = summed[..., :1]  # the first wave counts them
            # A token of a whole frame is the mean of the tower's 64.
            target = summed / n_objects.clamp(min=1e-6)
            is_known = n_objects[..., 0] > MIN_OBJECTS / 64
        error = (self.predict_maps(actions).float() - target[:, None]).square().mean((1, 3))
        return (error * is_known).sum(1) / is_known.sum(1).clamp(min=1)
