"""The squeeze-and-excitation bottleneck that turns vision features into MemoryVLA's perceptual tokens."""

import torch
from torch import Tensor, nn

SQUEEZE = 16  # how much narrower the channels' own bottleneck is


class Compression(nn.Module):
    """[b, p, c] → [b, p, d]: reduce, weigh the channels by their mean over the patches, expand."""

    def __init__(self, c: int, middle: int, d: int) -> None:
        super().__init__()
        self.reduce = nn.Linear(c, middle, bias=False)
        self.squeeze = nn.Linear(middle, middle // SQUEEZE)
        self.excite = nn.Linear(middle // SQUEEZE, middle)
        self.expand = nn.Linear(middle, d, bias=False)

    def forward(self, features: Tensor) -> Tensor:
        x = self.reduced(features)
        return self.expand(x * self.weights(x)[:, None])

    def reduced(self, features: Tensor) -> Tensor:
        """Features at the middle width [b, p, m]."""
        return torch.relu(self.reduce(features))

    def weights(self, x: Tensor) -> Tensor:
        """The weight in [0, 1] of each channel [b, m]."""
        return torch.sigmoid(self.excite(torch.relu(self.squeeze(x.mean(1)))))
