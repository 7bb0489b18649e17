"""Pointing: where tokens say that objects are, and which of them is pointed at."""

import pytest
import torch
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from mme_vla import UserError, build_policy
from mme_vla.extras.nano.pointer import Pointer
from mme_vla.extras.nano.pretraining import label_cells
from mme_vla.extras.nano.tower import (
    CLASSES,
    COLUMNS,
    ROWS,
    TOKEN_WIDTH,
    located,
    place_waves,
    reflect,
    reflect_points,
    summarise,
    within,
)
from mme_vla.extras.trajectories.choice import SPREAD, WEIGHT, ChoiceHead
from mme_vla.testing.small import random_batch
from mme_vla.types import HistoryTokens

RED, BLUE = CLASSES.index("red cube"), CLASSES.index("blue cube")


def image_of(*objects: tuple[int, float, float]) -> torch.Tensor:
    """Tokens [1, 64, d] of an image with objects: class, column and row as shares of its side."""
    kinds, places = torch.tensor([o[0] for o in objects]), torch.tensor([o[1:] for o in objects])
    return summarise(
        *label_cells(torch.zeros(len(objects), dtype=torch.long), kinds, places, (1, 32))
    )


def test_tokens_say_where_an_object_is() -> None:
    presence, where = located(image_of((RED, 0.43, 0.31)))
    token = presence[0, :, RED].argmax()
    expected = torch.tensor([within(0.43, COLUMNS), within(0.31, ROWS)])
    assert presence[0, token, RED] == 1
    assert presence[0, :, BLUE].max() == 0
    assert torch.allclose(where[0, token, RED], expected, atol=0.01)


@pytest.mark.parametrize("exchange", [False, True])
@pytest.mark.parametrize("signs", [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_reflected_tokens_are_those_of_objects_at_reflected_points(
    signs: tuple[float, float], exchange: bool
) -> None:
    objects = [(RED, 0.43, 0.31), (BLUE, 0.6, 0.2), (RED, 0.35, 0.15)]
    how = torch.tensor([signs]), torch.tensor([exchange])
    points = reflect_points(torch.tensor([[[row, column] for _, column, row in objects]]), *how)[
        0
    ].tolist()
    expected = image_of(
        *((kind, column, row) for (kind, _, _), (row, column) in zip(objects, points, strict=True))
    )
    reflected = reflect(image_of(*objects), *how)
    # presence is the largest of a token's cells, and tokens keep their order
    sums = slice(len(CLASSES), None)
    assert torch.allclose(reflected.sum(1)[:, sums], expected.sum(1)[:, sums], atol=1e-4)
    if signs == (1.0, 1.0) and not exchange:
        assert torch.equal(reflected, image_of(*objects))


def test_a_pointer_points_at_classes_of_the_query_that_it_weighs() -> None:
    pointer, action = Pointer(8, 32, 2), torch.ones(1, 1, 8)
    selected = torch.zeros(1, 2, len(CLASSES))
    selected[0, 0, RED] = selected[0, 1, BLUE] = 1
    tokens = image_of((RED, 0.43, 0.31), (BLUE, 0.6, 0.2))
    with torch.no_grad():
        pointer.query.weight.zero_()
        pointer.query.bias.zero_()
        for query, kind in ((0, RED), (1, BLUE)):
            pointer.goals.weight.zero_()
            pointer.goals.bias.copy_(torch.tensor([10.0, -10.0] if query == 0 else [-10.0, 10.0]))
            logits = pointer(action, tokens, selected)[0, 0, : 64 * len(CLASSES)]
            assert logits.argmax() % len(CLASSES) == kind


def test_a_pointer_that_learned_a_class_at_some_places_finds_it_at_others() -> None:
    torch.manual_seed(0)
    pointer, queries, selected = (
        Pointer(8, 32, 2),
        torch.ones(1, 1, 8),
        torch.full((1, 2, len(CLASSES)), 1 / len(CLASSES)),
    )
    head = ChoiceHead(horizon=1, action_dim=3, choice=[0])
    optimizer = torch.optim.Adam(pointer.parameters(), 1e-2)
    places = torch.rand(8, 4).tolist()

    def scene(place: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
        red, blue = (
            (0.2 + 0.6 * place[0], 0.1 + 0.2 * place[1]),
            (0.2 + 0.6 * place[2], 0.35 + 0.15 * place[3]),
        )
        target = torch.tensor([[[1.0, within(red[1], ROWS), within(red[0], COLUMNS)]]])
        return image_of((RED, *red), (BLUE, *blue)), target

    scenes = [scene(place) for place in places]
    for _ in range(40):
        for tokens, target in scenes:
            optimizer.zero_grad()
            output = torch.cat([torch.zeros(1, 1, 3), pointer(queries, tokens, selected)], -1)
            head.loss(
                lambda x, time, output=output: output,
                target,
                head.training_noise(1, torch.Generator()),
            ).backward()
            optimizer.step()
    for place in torch.rand(6, 4).tolist():
        tokens, target = scene(place)
        output = torch.cat([torch.zeros(1, 1, 3), pointer(queries, tokens, selected)], -1)
        chunk = head.scores(output, torch.zeros(1, 1, 3))
        assert (chunk - target)[..., 1:].abs().max() < 0.1


def test_the_loss_of_a_mixture_is_its_negative_log_likelihood() -> None:
    generator = torch.Generator().manual_seed(0)
    logits, points = torch.randn(5, generator=generator), torch.randn(5, 2, generator=generator)
    head, actions = (
        ChoiceHead(horizon=1, action_dim=3, choice=[0]),
        torch.tensor([[[1.0, 0.3, -0.2]]]),
    )
    output = torch.cat([torch.zeros(3), logits, points.flatten()])[None, None]
    loss = head.loss(lambda x, time: output, actions, head.training_noise(1, torch.Generator()))
    mixture = MixtureSameFamily(Categorical(logits=logits), Independent(Normal(points, SPREAD), 1))
    # the constant that the loss leaves out
    peak = Normal(0.0, SPREAD).log_prob(torch.tensor(0.0)) * 2
    assert loss.item() == pytest.approx(
        -WEIGHT * (mixture.log_prob(actions[0, 0, 1:]) - peak).item(), rel=1e-5
    )
    chunk = head.scores(output, torch.zeros(1, 1, 3))
    assert torch.equal(chunk[0, 0, 1:], points[logits.argmax()])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"backbone.vision.layout": "segments", "backbone.goal": "swap"},
            "point=objects needs places",
        ),
        ({"backbone.point": "object"}, "point='object'"),
        ({"backbone": "nano", "embodiment": "robomme_waypoint_front"}, "choices with a point"),
    ],
)
def test_pointing_without_what_it_needs_is_refused(changed: dict[str, str], words: str) -> None:
    options = {
        "backbone": "nano_choice",
        "embodiment": "robomme_choice_front",
        "backbone.point": "objects",
        **changed,
    }
    with pytest.raises(UserError, match=words):
        build_policy("pi05", **options)


def history_of(*frames: torch.Tensor) -> HistoryTokens:
    """A history [1, n] of frames pooled to one token each."""
    features = torch.stack([frame.mean(1) for frame in frames], 1)
    rows = len(frames)
    return HistoryTokens(
        features, torch.zeros(1, rows, 3), torch.ones(1, rows, dtype=torch.bool), torch.zeros(1)
    )


def test_the_target_of_a_map_is_where_the_history_shows_the_selected_class() -> None:
    pointer, selected = Pointer(8, 32, 2), torch.zeros(1, 2, len(CLASSES))
    selected[0, 0, RED] = selected[0, 1, BLUE] = 1
    place = torch.tensor([within(0.43, COLUMNS), within(0.31, ROWS)])
    with torch.no_grad():
        pointer.recall.weight.zero_()
        pointer.recall.bias.copy_(torch.cat([place_waves(place), torch.full((16,), 9.0)]))
    image, empty = image_of((RED, 0.43, 0.31)), torch.zeros(1, 64, TOKEN_WIDTH)
    # No frame shows the blue cube: its map is no error.
    loss = pointer.localization_loss(torch.ones(1, 1, 8), history_of(empty, image, empty), selected)
    assert loss.item() < 1e-3
    elsewhere = pointer.localization_loss(
        torch.ones(1, 1, 8), history_of(empty, image_of((RED, 0.6, 0.1))), selected
    )
    assert elsewhere.item() > 0.1
    assert (
        pointer.localization_loss(torch.ones(1, 1, 8), history_of(empty, empty), selected).item()
        == 0
    )


def test_an_object_at_a_place_of_high_density_is_likelier() -> None:
    pointer, action = Pointer(8, 32, 1), torch.ones(1, 1, 8)
    place = torch.tensor([within(0.6, COLUMNS), within(0.2, ROWS)])
    with torch.no_grad():
        for layer in (pointer.query, pointer.counts, pointer.recall):
            layer.weight.zero_()
            layer.bias.zero_()
        pointer.counts.bias.copy_(torch.tensor([9.0, 0.0]))
        pointer.recall.bias.copy_(place_waves(place))
    output = pointer(
        action, image_of((RED, 0.43, 0.31), (RED, 0.6, 0.2)), torch.full((1, 1, len(CLASSES)), 0.05)
    )
    logits, points = output[0, 0].tensor_split([64 * len(CLASSES)])
    assert torch.allclose(points.view(-1, 2)[logits.argmax()], place.flip(0), atol=0.02)


@pytest.mark.parametrize(
    ("model", "options"),
    [("framesamp_modul", {"memory.budget": 4, "memory.grid": 1}), ("pi05", {})],
)
def test_policies_with_memory_have_a_localization_loss(model: str, options: dict[str, int]) -> None:
    policy = build_policy(
        model, backbone="nano_choice", embodiment="robomme_choice_front", **options
    )
    policy.train()(random_batch(policy))[0].backward()
    assert policy.backbone.pointer is not None
    assert (policy.backbone.pointer.recall.weight.grad is not None) == (model == "framesamp_modul")
