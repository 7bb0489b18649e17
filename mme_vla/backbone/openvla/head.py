"""What OpenVLA-OFT adds to the VLM: a token of the state, and a head that regresses a chunk."""

from torch import Tensor, nn


class StateToken(nn.Module):
    """Normalised state [b, s] → one token [b, 1, d]."""

    def __init__(self, state_dim: int, width: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(state_dim, width), nn.Linear(width, width)

    def forward(self, state: Tensor) -> Tensor:
        return self.fc2(nn.functional.gelu(self.fc1(state)))[:, None]


class ResidualMLP(nn.Module):
    """x + ReLU(W LayerNorm(x))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm, self.linear = nn.LayerNorm(width), nn.Linear(width, width)

    def forward(self, x: Tensor) -> Tensor:
        return x + nn.functional.relu(self.linear(self.norm(x)))


class ActionHead(nn.Module):
    """Hidden states of a step's slots, side by side → that step's action; no activation at the end."""

    def __init__(self, width: int, action_dim: int, blocks: int = 2) -> None:
        super().__init__()
        self.input_norm, self.input = nn.LayerNorm(action_dim * width), nn.Linear(action_dim * width, width)
        self.blocks = nn.ModuleList(ResidualMLP(width) for _ in range(blocks))
        self.output_norm, self.output = nn.LayerNorm(width), nn.Linear(width, action_dim)

    def forward(self, slots: Tensor) -> Tensor:
        """[b, h, a·d] → [b, h, a]."""
        x = nn.functional.relu(self.input(self.input_norm(slots)))
        for block in self.blocks:
            x = block(x)
        return self.output(self.output_norm(x))
