"""A categorical head: letters of the options by cross-entropy, all other numbers by regression, in
one pass.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from mme_vla.backbone.flow import FlowHead, Predict, PredictAt
from mme_vla.errors import require
from mme_vla.registry import HEADS
from mme_vla.types import Noise, Overlap

SPREAD = 0.14
"""Standard deviation of a point about the object that is pointed at, in normalised units."""
WEIGHT = 0.5  # of a mixture's negative log-likelihood, beside the letter's cross-entropy


def normal_log_density(x: Tensor, deviation: float) -> Tensor:
    """Log-density [b] of x [b, …] under independent normal distributions of this standard
    deviation.
    """
    x = x.flatten(1)
    normaliser = math.log(deviation) + 0.5 * math.log(2 * math.pi)
    return -0.5 * (x / deviation).square().sum(1) - x.shape[1] * normaliser


@HEADS.register("choice")
class ChoiceHead(FlowHead):
    """Reads the network's output as logits of letters and means of the other numbers.

    The network sees no noise: its noisy chunk is 0 and its flow time 1. A sampled letter is the
    best score among those offered (`ActionSpace.decide`), and a score is a logit with Gumbel noise,
    so that the choice is an exact sample of the softmax over the offered letters.

    A network may give more than a numbers: the logits of m components and their points, 3·m numbers
    (`Pointer`). Then the point is a mixture of normal distributions about them, and the mean of the
    most probable component is taken.

    Args:
        horizon, action_dim: of a chunk [h, a].
        time_distribution: has no effect.
        choice: the columns of the letters, `embodiment.action.choice`.
        temperature: of the letters' softmax while sampling; 0 takes the best letter.
        deviation: standard deviation of the other numbers while sampling, in normalised units; 0
            takes the mean.
    """

    supports_rtc = False

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        choice: Sequence[int],
        time_distribution: str = "beta",
        temperature: float = 1.0,
        deviation: float = 0.0,
    ):
        super().__init__(horizon, action_dim, time_distribution, steps=1, deviation=deviation)
        require(
            len(choice) and all(0 <= place < action_dim for place in choice),
            f"backbone.head.choice={list(choice)} must list the columns of the letters, 0 to"
            f" {action_dim - 1}. Set embodiment=robomme_choice and"
            " head.choice=${embodiment.action.choice}.",
        )
        require(temperature >= 0, f"backbone.head.temperature={temperature} must not be negative.")
        self.choice = list(choice)
        self.temperature = temperature
        self.numbers = [place for place in range(action_dim) if place not in self.choice]

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """`noise` [n, h, a] of zeros and `time` [n] of ones: the loss has no noise."""
        noise = torch.zeros(count, self.horizon, self.action_dim)
        return {"noise": noise, "time": torch.ones(count)}

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """`noise` [h, a] on the CPU: standard Gumbel for letters, standard normal for the other
        numbers.
        """
        uniform = torch.rand(self.horizon, len(self.choice), generator=generator).clamp(min=1e-20)
        noise = torch.randn(self.horizon, self.action_dim, generator=generator)
        noise[:, self.choice] = -(-uniform.log()).log()
        return {"noise": noise}

    def loss(self, predict: Predict, actions: Tensor, noise: Mapping[str, Tensor]) -> Tensor:
        """The loss [b, h]: cross-entropy of the letter, plus the mean squared error of the other
        numbers.

        Of a mixture it is plus half the negative log-likelihood, up to a constant, instead.
        """
        output = predict(noise["noise"], noise["time"]).float()
        letters = actions[..., self.choice].argmax(-1)
        logits = output[..., self.choice].movedim(-1, 1)
        loss = nn.functional.cross_entropy(logits, letters, reduction="none")
        if not self.numbers:
            return loss
        numbers = actions[..., self.numbers].float()
        if output.shape[-1] == self.action_dim:
            return loss + (output[..., self.numbers] - numbers).square().mean(-1)
        components, points = self._mixture(output)
        distance = (points - numbers[..., None, :]).square().sum(-1)
        log_density = (components.log_softmax(-1) - distance / (2 * SPREAD**2)).logsumexp(-1)
        return loss - WEIGHT * log_density

    def _mixture(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Logits [b, h, m] and points [b, h, m, 2]."""
        count = (output.shape[-1] - self.action_dim) // 3
        logits, points = output[..., self.action_dim :].tensor_split([count], -1)
        return logits, points.unflatten(-1, (-1, 2))

    def _means(self, output: Tensor) -> Tensor:
        """Logits of the letters and means of the other numbers [b, h, a]."""
        if output.shape[-1] == self.action_dim:
            return output
        logits, points = self._mixture(output)
        best = logits.argmax(-1)[..., None, None].expand(*logits.shape[:-1], 1, 2)
        means = output[..., : self.action_dim].clone()
        means[..., self.numbers] = points.gather(-2, best)[..., 0, :]
        return means

    def times(self, steps: int, device: torch.device) -> Tensor:
        """One [1]: the network is called once, whatever `steps` is."""
        return torch.ones(1, device=device)

    def start(self, noise: Mapping[str, Tensor], steps: int, overlap: Overlap | None) -> Tensor:
        """Zeros [b, h, a]: the network sees no noise."""
        return torch.zeros_like(noise["noise"])

    def velocity(self, predict: PredictAt, times: Tensor, noise: Mapping[str, Tensor]) -> PredictAt:
        """The difference of x and the `scores`, at which the one step thus ends."""

        def velocity(x: Tensor, index: int) -> Tensor:
            return x - self.scores(predict(x, index), noise["noise"])

        return velocity

    def scores(self, output: Tensor, noise: Tensor) -> Tensor:
        """Scores of the letters and the other numbers, [b, h, a], from the network's output."""
        means = self._means(output.float())
        scale = means.new_full((self.action_dim,), self.deviation)
        scale[self.choice] = self.temperature
        return means + scale * noise

    def log_prob(self, predict: PredictAt, chunk: Tensor, options: Tensor | None) -> Tensor:
        """Log-probability [b, h] of the choices that `ActionSpace.decide` makes of sampled chunks
        [b, h, a].

        Args:
            chunk: what was sampled, or the executed actions as the network predicts them.
            options: [b, letters] bool; the letters offered. None means all.

        Returns:
            Log-probability of the letter, plus the log-density of the other numbers if `deviation`
            is positive.
        """
        require(
            self.temperature > 0,
            "backbone.head.temperature=0 has no log-probability: set a positive temperature.",
        )
        output = self._means(predict(torch.zeros_like(chunk), 0).float())
        logits = output[..., self.choice] / self.temperature
        scores = chunk[..., self.choice]
        if options is not None:
            refused = ~options[:, None]
            logits = logits.masked_fill(refused, -torch.inf)
            scores = scores.masked_fill(refused, -torch.inf)
        letters = scores.argmax(-1, keepdim=True)
        log_prob = logits.log_softmax(-1).gather(-1, letters)[..., 0]
        if self.deviation and self.numbers:
            error = (chunk - output)[..., self.numbers]
            density = normal_log_density(error.flatten(0, 1), self.deviation)
            log_prob = log_prob + density.unflatten(0, error.shape[:2])
        return log_prob
