"""The nano backbone's vision tower: what its tokens say, alone and pooled, and the towers of
earlier checkpoints.
"""

import math
from dataclasses import asdict
from importlib.resources import files

import pytest
import torch
from torch import Tensor

from mme_vla import UserError, build_policy
from mme_vla.backbone.siglip import pool_grid
from mme_vla.extras.nano.pretraining import fresh_tower, label_cells
from mme_vla.extras.nano.tower import (
    CLASSES,
    COLUMNS,
    FACTORS,
    FAINT,
    NOTHING,
    ROWS,
    WAVES,
    WEIGHTS,
    TowerConfig,
    summarise,
)
from mme_vla.policy.mme import MMEPolicy

K = len(CLASSES)
RED, CONTAINER = CLASSES.index("red cube"), CLASSES.index("container")


def pooled_tokens(*objects: tuple[int, float, float]) -> tuple[Tensor, ...]:
    """Presence, share, column, row and waves, without their factors, of a frame's one token."""
    kinds, places = torch.tensor([o[0] for o in objects]), torch.tensor([o[1:] for o in objects])
    labels = label_cells(torch.zeros(len(objects), dtype=torch.long), kinds, places, (1, 32))
    tokens = summarise(*labels)
    assert tokens.shape == (1, 64, 20 * K)
    token = pool_grid(tokens, 1)[0, 0] * 64
    parts = token.split([K, K, K, K, WAVES**2 * K])
    return tuple(part / factor for part, factor in zip(parts, FACTORS, strict=True))


def within(place: float, ends: tuple[float, float]) -> float:
    return (2 * place - 1 - sum(ends) / 2) / ((ends[1] - ends[0]) / 2)


def test_the_one_token_of_a_frame_says_where_the_object_of_a_class_is() -> None:
    _, share, column, row, waves = pooled_tokens((RED, 0.41, 0.23), (CONTAINER, 0.6, 0.3))
    assert share[RED] == pytest.approx(1 / (1 + FAINT), abs=1e-3) and share[0] == 0
    assert column[RED] / share[RED] == pytest.approx(within(0.41, COLUMNS), abs=1e-4)
    assert row[RED] / share[RED] == pytest.approx(within(0.23, ROWS), abs=1e-4)
    of_red = waves.view(K, WAVES, WAVES)[RED]
    c, r = (within(0.41, COLUMNS) + 1) / 2, (within(0.23, ROWS) + 1) / 2
    assert of_red[2, 1] == pytest.approx(
        math.cos(2 * math.pi * c) * math.cos(math.pi * r), abs=1e-4
    )


def test_several_objects_of_a_class_are_counted_and_their_middle_is_kept() -> None:
    _, share, column, _, waves = pooled_tokens((RED, 0.3, 0.2), (RED, 0.5, 0.2), (RED, 0.55, 0.4))
    assert waves.view(K, -1)[RED, 0] == pytest.approx(3, abs=1e-4)
    assert column[RED] / share[RED] == pytest.approx(within(0.45, COLUMNS), abs=1e-4)


def test_presence_is_in_the_token_of_the_object_alone() -> None:
    labels = label_cells(
        torch.tensor([0]), torch.tensor([RED]), torch.tensor([[0.19, 0.31]]), (1, 32)
    )
    presence = summarise(*labels)[0, :, :K].view(8, 8, K)
    assert presence[2, 1, RED] == 1 and presence.sum() == 1


def test_nearly_empty_cells_add_up_to_nothing() -> None:
    tokens = summarise(torch.full((1, K, 32, 32), 0.05), torch.zeros(1, K, 2, 32, 32))
    assert not tokens.any()


@pytest.mark.parametrize(("in_use", "rows"), [(0.625, 5), (1.0, 8)])
def test_a_tower_sees_the_part_of_the_image_that_is_in_use(in_use: float, rows: int) -> None:
    config = TowerConfig(128, 16, 16, 16, 1, 1, 1, layout="places", in_use=in_use)
    logits, _ = fresh_tower(config, 0).locate(torch.zeros(1, 3, 128, 128))
    assert logits.shape[-2:] == (32, 32)
    is_seen = (logits[0] > NOTHING).any(0).any(-1)
    assert is_seen.tolist() == [True] * 4 * rows + [False] * (32 - 4 * rows)


def test_in_use_is_a_share() -> None:
    with pytest.raises(UserError, match=r"in_use=1\.5 must be more than 0 and at most 1"):
        TowerConfig(layout="places", in_use=1.5)


def test_a_fresh_tower_reports_nothing_and_its_seed_makes_it() -> None:
    config = TowerConfig(32, 8, 8, 8, layout="places", pretrained=False)
    one, two = fresh_tower(config, 3), fresh_tower(config, 3)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), two.parameters(), strict=True))
    tokens = one(torch.rand(2, 3, 32, 32))
    assert tokens.shape == (2, 4, one.token_width) and not tokens[:, :, :K].any()


def test_the_shipped_weights_are_small_and_other_sizes_are_refused() -> None:
    assert len(files("mme_vla").joinpath(WEIGHTS).read_bytes()) < 10e6
    with pytest.raises(UserError, match=r"backbone\.vision\.pretrained=false"):
        build_policy("pi05", backbone="nano", **{"backbone.vision.width_8": 80})  # type: ignore[arg-type]
    with pytest.raises(UserError, match="layout=segments is of checkpoints"):
        build_policy(
            "pi05",
            backbone="nano",
            **{"backbone.vision.layout": "segments", "backbone.goal": "swap"},
        )  # type: ignore[arg-type]


def test_the_checkpoint_of_before_keeps_its_tower() -> None:
    """A red square on the table's grey, where a cube is seen: present in its token, and nowhere far
    from it.
    """
    from mme_vla.extras.nano.vision import CLASSES as SEGMENTS
    from mme_vla.extras.nano.vision import ConvTower

    tower = MMEPolicy.from_pretrained("nano").backbone.vision
    assert isinstance(tower, ConvTower) and tower.words.any()
    image = torch.full((1, 3, 128, 128), 0.3)
    image[0, :, 52:60, 66:74] = torch.tensor([0.7, -0.9, -0.9])[:, None, None]
    with torch.no_grad():
        shares = tower.answers(image)[0].softmax(2)[0]  # token, class, place
    red = shares[:, SEGMENTS.index("red cube")].amax(-1).view(8, 8)
    assert red.argmax() == 3 * 8 + 4 and red[3, 4] > 0.5
    assert shares[:, SEGMENTS.index("green cube")].max() < 0.5


def test_configurations_without_a_layout_are_of_the_earlier_tower() -> None:
    assert asdict(TowerConfig())["layout"] == "segments"
