"""The categorical head: its samples, its log-probabilities and its loss."""

import pytest
import torch
from torch.distributions import Categorical, Normal

from mme_vla import UserError
from mme_vla.embodiment.action_space import ActionSpace, Option
from mme_vla.extras.trajectories.choice import ChoiceHead

LOGITS = torch.tensor([0.5, -1.0, 2.0, 0.0])
OFFERED = torch.tensor([True, True, False, True])
OUTPUT = torch.cat([LOGITS, torch.tensor([0.25, 0.75])]).expand(1, 1, -1)


def head(**options: float) -> ChoiceHead:
    return ChoiceHead(horizon=1, action_dim=6, choice=[0, 1, 2, 3], **options)


def predict(output: torch.Tensor):
    return lambda x, index: output.expand(len(x), -1, -1)


@pytest.mark.parametrize("temperature", [1.0, 0.5])
def test_choices_are_sampled_from_the_softmax_over_the_offered_letters(temperature: float) -> None:
    space = ActionSpace(6, choice=(0, 1, 2, 3), point=(4, 5), frames=None, horizon=1, execute=1)
    options = [Option("abcd"[i], "act") for i in OFFERED.nonzero()[:, 0].tolist()]
    one, generator, count = head(temperature=temperature), torch.Generator().manual_seed(0), 20_000
    noise = torch.stack([one.sampling_noise(generator)["noise"] for _ in range(count)])
    chunks = one.scores(OUTPUT, noise)
    frequency = space.decide(chunks, options)[:, 0, :4].mean(0)
    expected = (LOGITS / temperature).masked_fill(~OFFERED, -torch.inf).softmax(0)
    assert (frequency - expected).abs().max() < 0.015
    assert torch.equal(chunks[:, 0, 4:], OUTPUT[0, :, 4:].expand(count, -1)), (
        "without deviation the mean is taken"
    )


def test_the_log_probability_is_that_of_the_distributions() -> None:
    one, generator = head(temperature=0.5, deviation=0.1), torch.Generator().manual_seed(0)
    noise = torch.stack([one.sampling_noise(generator)["noise"] for _ in range(50)])
    chunks = one.scores(OUTPUT, noise)
    letters = chunks[..., :4].masked_fill(~OFFERED, -torch.inf).argmax(-1)
    categorical = Categorical(logits=(LOGITS / 0.5).masked_fill(~OFFERED, -torch.inf))
    expected = categorical.log_prob(letters) + Normal(OUTPUT[0, 0, 4:], 0.1).log_prob(
        chunks[..., 4:]
    ).sum(-1)
    log_prob = one.log_prob(predict(OUTPUT), chunks, OFFERED.expand(50, -1))
    assert torch.allclose(log_prob, expected, atol=1e-5)


def test_temperature_zero_takes_the_best_letter_and_has_no_log_probability() -> None:
    one = head(temperature=0.0)
    noise = torch.stack(
        [one.sampling_noise(torch.Generator().manual_seed(seed))["noise"] for seed in range(20)]
    )
    assert torch.equal(one.scores(OUTPUT, noise), OUTPUT.expand(20, -1, -1))
    with pytest.raises(UserError, match="temperature=0 has no log-probability"):
        one.log_prob(predict(OUTPUT), OUTPUT, None)


def test_the_loss_is_cross_entropy_of_the_letter_and_squared_error_of_the_point() -> None:
    actions = torch.tensor([[[-1.0, 1.0, -1.0, -1.0, 0.5, 0.5]]])
    noise = head().training_noise(1, torch.Generator())
    loss = head().loss(lambda x, time: OUTPUT, actions, noise)
    assert loss.item() == pytest.approx(-LOGITS.log_softmax(0)[1].item() + 0.0625, abs=1e-6)


def test_columns_outside_of_an_action_are_refused() -> None:
    with pytest.raises(UserError, match=r"head\.choice=\[6\].*0 to 5"):
        ChoiceHead(horizon=1, action_dim=6, choice=[6])
