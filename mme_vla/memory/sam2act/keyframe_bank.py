"""A bank of keyframes: written after every look, read before every decision. Its state belongs to an episode."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from mme_vla.memory.sam2act.keyframe_encoder import MemoryEncoder, sine_positions
from mme_vla.memory.sam2act.memory_attention import MemoryAttention

_SHARPNESS, _SHIFT = 20.0, 10.0  # a heatmap's logits become a mask of −10 to 10, as in SAM2


@dataclass(frozen=True)
class BankState:
    """What an episode remembers: maps [n, g², m] of its latest keyframes, n views, the oldest first."""

    maps: tuple[Tensor, ...] = ()

    def __len__(self) -> int:
        return len(self.maps)


class KeyframeBank(nn.Module):
    """Reads and writes the states; keeps none itself.

    Views stand in the batch axis n and never see each other: n is 3 for one episode, 3·b for b in step.
    """

    def __init__(
        self, *, grid: int, token: int, memory: int, layers: int, feedforward: int, mask_stages: int, remembered: int
    ) -> None:
        """Build encoder and attention.

        Args:
            grid: side of a view's grid of tokens. token: their width. memory: width of what is kept of each.
            layers, feedforward: of the attention. mask_stages: halvings from a heatmap's picture to the grid.
            remembered: most keyframes that are read.
        """
        super().__init__()
        self.grid, self.mask_stages, self.remembered = grid, mask_stages, remembered
        self.encoder = MemoryEncoder(token, memory, mask_stages)
        self.attention = MemoryAttention(token, memory, feedforward, layers)
        self.ages = nn.Parameter(torch.randn(remembered, memory) * 0.02)

    def init_state(self) -> BankState:
        """The state of an episode that has seen nothing."""
        return BankState()

    def read(self, state: BankState, tokens: Tensor, positions: Tensor) -> Tensor:
        """Tokens [n, d, g, g] with what is remembered; unchanged where nothing is.

        Args:
            positions: [n, g², d], the tokens' own.
        """
        recent = state.maps[::-1][: self.remembered]
        if not recent:
            return tokens
        places = self.positions().to(tokens)  # g² m
        aged = [(places + self.ages[age]).expand_as(kept) for age, kept in enumerate(recent)]
        x = tokens.flatten(2).transpose(1, 2)
        x = self.attention(x, positions, torch.cat(recent, 1), torch.cat(aged, 1))
        return x.transpose(1, 2).view_as(tokens)

    def update(self, state: BankState, tokens: Tensor, logits: Tensor) -> BankState:
        """The state after a keyframe.

        Args:
            tokens: [n, d, g, g], as they were before `read`. logits: [n, 1, s, s], its heatmaps.
        """
        side = self.grid * 2**self.mask_stages
        mask = nn.functional.interpolate(logits.float(), (side, side), mode="bilinear")
        kept = self.encoder(tokens, mask.sigmoid() * _SHARPNESS - _SHIFT).flatten(2).transpose(1, 2)
        return BankState((*state.maps, kept)[-self.remembered :])

    def positions(self) -> Tensor:
        """Where remembered places stand, [g², m]."""
        return sine_positions(self.grid, self.ages.shape[1], self.ages.device).flatten(1).T


def released_positions(table: Tensor, batch: int) -> Tensor:
    """The positions [b·3, g², d] under which tokens read the bank, of the transformer's table [1, 3·g², d].

    The released code reshapes where it should have transposed, batch and all: place p of view i of sample s gets row
    (3·b·p + 3·s + i) of the table repeated b times. Weights trained so need the same.
    """
    rows, width = table.shape[1:]
    places = rows // 3
    mixed = table.repeat(batch, 1, 1).reshape(places, 3 * batch, width)
    return mixed.transpose(0, 1)
