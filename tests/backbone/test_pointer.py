"""Pointing: where tokens say that objects are, and which of them is pointed at."""

import pytest
import torch
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from mme_vla import UserError, build_policy
from mme_vla.backbone.choice import SPREAD, WEIGHT, ChoiceHead
from mme_vla.backbone.pointer import Pointer
from mme_vla.backbone.tower import CLASSES, COLUMNS, ROWS, located, summarise, within
from mme_vla.nano.pretraining import label_cells

RED, BLUE = CLASSES.index("red cube"), CLASSES.index("blue cube")


def image_of(*objects: tuple[int, float, float]) -> torch.Tensor:
    """Tokens [1, 64, d] of an image with objects: class, column and row as shares of its side."""
    kinds, places = torch.tensor([o[0] for o in objects]), torch.tensor([o[1:] for o in objects])
    return summarise(*label_cells(torch.zeros(len(objects), dtype=torch.long), kinds, places, (1, 32)))


def test_tokens_say_where_an_object_is() -> None:
    presence, where = located(image_of((RED, 0.43, 0.31)))
    token = presence[0, :, RED].argmax()
    expected = torch.tensor([within(0.43, COLUMNS), within(0.31, ROWS)])
    assert presence[0, token, RED] == 1
    assert presence[0, :, BLUE].max() == 0
    assert torch.allclose(where[0, token, RED], expected, atol=0.01)


def test_a_pointer_that_learned_a_class_at_some_places_finds_it_at_others() -> None:
    torch.manual_seed(0)
    pointer, asked, selected = Pointer(8, 32, 2), torch.ones(1, 1, 8), torch.zeros(1, 2, len(CLASSES))
    head = ChoiceHead(horizon=1, action_dim=3, choice=[0])
    optimizer = torch.optim.Adam(pointer.parameters(), 1e-2)
    places = torch.rand(8, 4).tolist()

    def scene(place: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
        red, blue = (0.2 + 0.6 * place[0], 0.1 + 0.2 * place[1]), (0.2 + 0.6 * place[2], 0.35 + 0.15 * place[3])
        target = torch.tensor([[[1.0, within(red[1], ROWS), within(red[0], COLUMNS)]]])
        return image_of((RED, *red), (BLUE, *blue)), target

    scenes = [scene(place) for place in places]
    for _ in range(40):
        for tokens, target in scenes:
            optimizer.zero_grad()
            output = torch.cat([torch.zeros(1, 1, 3), pointer(asked, tokens, selected)], -1)
            head.loss(
                lambda x, time, output=output: output, target, head.training_noise(1, torch.Generator())
            ).backward()
            optimizer.step()
    for place in torch.rand(6, 4).tolist():
        tokens, target = scene(place)
        output = torch.cat([torch.zeros(1, 1, 3), pointer(asked, tokens, selected)], -1)
        chunk = head.sample(lambda x, index, output=output: output, torch.zeros(1, 1, 3), 1)
        assert (chunk - target)[..., 1:].abs().max() < 0.1


def test_the_loss_of_a_mixture_is_its_negative_log_likelihood() -> None:
    generator = torch.Generator().manual_seed(0)
    logits, points = torch.randn(5, generator=generator), torch.randn(5, 2, generator=generator)
    head, actions = ChoiceHead(horizon=1, action_dim=3, choice=[0]), torch.tensor([[[1.0, 0.3, -0.2]]])
    output = torch.cat([torch.zeros(3), logits, points.flatten()])[None, None]
    loss = head.loss(lambda x, time: output, actions, head.training_noise(1, torch.Generator()))
    mixture = MixtureSameFamily(Categorical(logits=logits), Independent(Normal(points, SPREAD), 1))
    peak = Normal(0.0, SPREAD).log_prob(torch.tensor(0.0)) * 2  # the constant that the loss leaves out
    assert loss.item() == pytest.approx(-WEIGHT * (mixture.log_prob(actions[0, 0, 1:]) - peak).item(), rel=1e-5)
    chunk = head.sample(lambda x, index: output, torch.zeros(1, 1, 3), 1)
    assert torch.equal(chunk[0, 0, 1:], points[logits.argmax()])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"backbone.vision.layout": "segments", "backbone.goal": "swap"}, "point=objects needs places"),
        ({"backbone.point": "object"}, "point='object'"),
        ({"backbone": "nano", "embodiment": "robomme_waypoint_front"}, "choices with a point"),
    ],
)
def test_pointing_without_what_it_needs_is_refused(changed: dict[str, str], words: str) -> None:
    options = {"backbone": "nano_choice", "embodiment": "robomme_choice_front", "backbone.point": "objects", **changed}
    with pytest.raises(UserError, match=words):
        build_policy("pi05", **options)
