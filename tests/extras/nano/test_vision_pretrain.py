"""The command that trains the small tower: its labels, its training, what it measures, and the
scenes it takes.
"""

import logging
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla import UserError
from mme_vla.config.composition import compose, resolved
from mme_vla.config.sections import read_section
from mme_vla.envs.grounding import project
from mme_vla.envs.robomme.scene.placement import SceneError
from mme_vla.extras.nano import pretraining, scenes
from mme_vla.extras.nano.cli import vision_pretrain
from mme_vla.extras.nano.cli.vision_pretrain import PretrainRun, run
from mme_vla.extras.nano.pretraining import (
    PretrainSettings,
    Scenes,
    augmented,
    evaluate_tower,
    find_objects,
    fresh_tower,
    label_cells,
    match,
    on_plane,
    pretrain,
    report,
    tower_loss,
)
from mme_vla.extras.nano.scenes import Place, visible_places
from mme_vla.extras.nano.tower import CLASSES, TowerConfig
from mme_vla.types import to_unit_range

RED, BUTTON = CLASSES.index("red cube"), CLASSES.index("button")
TINY = TowerConfig(32, 8, 8, 8, layout="places", pretrained=False)
CENTRES = np.array([[0.0, 0.1, 0.02], [-0.1, -0.15, 0.02], [0.05, 0.0, 0.01]])


def save_scene(path: Path, size: int = 32) -> Path:
    """Two images: the first has a red cube and a button, the second a red cube."""
    images = np.random.default_rng(0).integers(0, 256, (2, size, size, 3), dtype=np.uint8)
    places = np.column_stack([[0, 0, 1], [RED, BUTTON, RED], CENTRES]).astype(np.float32)
    np.savez_compressed(path, images=images, places=places)
    return path


class LabelTower(nn.Module):
    """Says what the labels of `scenes` say, moved by so much of an image; `only` of one class."""

    def __init__(self, scenes: Scenes, shifted: float = 0.0, only: int | None = None) -> None:
        super().__init__()
        selected = (
            torch.ones(len(scenes.classes), dtype=torch.bool)
            if only is None
            else scenes.classes == only
        )
        places = scenes.places[selected] + torch.tensor([shifted, 0.0])
        self.presence, self.offsets = label_cells(
            scenes.owners[selected], scenes.classes[selected], places, (2, 32)
        )

    def locate(self, images: Tensor) -> tuple[Tensor, Tensor]:
        return (self.presence - 0.5) * 20, self.offsets


def test_an_object_is_labelled_in_the_four_cells_around_it_and_detected() -> None:
    places = torch.tensor([[0.41, 0.23], [0.47, 0.23], [0.9, 0.01]])
    presence, offsets = label_cells(
        torch.tensor([0, 0, 1]), torch.tensor([RED, RED, BUTTON]), places, (2, 32)
    )
    assert presence[0, RED].sum() == 8 and presence[1, BUTTON].sum() == 2 and presence.sum() == 10
    assert offsets.abs().max() <= 1
    detected = sorted(find_objects(presence[0, RED], offsets[0, RED]))
    assert torch.allclose(torch.tensor(detected), places[:2], atol=1e-5)


def test_labels_move_with_their_image() -> None:
    """A white pixel stays where its place says it is."""
    images, place = torch.full((4, 3, 64, 64), -1.0), torch.tensor([[20.5, 30.5]]) / 64
    images[:, :, 30, 20] = 1
    rng = np.random.default_rng(1)
    shifted, places = augmented(images, place.repeat(4, 1), torch.arange(4), rng)
    assert len({float(p[0]) for p in places}) == 2  # mirrored or not
    for image, (column, row) in zip(shifted, places * 64, strict=True):
        assert image[0, int(row), int(column)] == 1


def test_what_is_hidden_or_outside_the_image_has_no_place() -> None:
    segmentation = np.zeros((256, 256), np.int32)
    segmentation[100:110, 100:110], segmentation[200, 200:205] = 3, 4
    away = np.array([0.2, 3.0, 0.02])
    places = [Place(RED, CENTRES[0], [3]), Place(BUTTON, CENTRES[1], [4]), Place(RED, away, [3])]
    visible = visible_places(places, segmentation)
    assert visible.shape == (1, 4) and np.allclose(visible[0], [RED, *CENTRES[0]])


def test_a_pixels_ray_meets_the_plane_where_the_point_was() -> None:
    for point in CENTRES:
        column, row = project(point)[::-1] / 256
        assert np.allclose(on_plane((column, row), point[2]), point[:2], atol=1e-6)


def test_the_evaluation_counts_places_detections_errors_and_wrong_reports(tmp_path: Path) -> None:
    made = Scenes.load([save_scene(tmp_path / "a.npz")])
    right = evaluate_tower(LabelTower(made), made)  # type: ignore[arg-type]
    assert (right["red cube"].places, right["red cube"].reports, right["hand"].places) == (2, 2, 0)
    assert len(right["red cube"].errors) == 2 and right["red cube"].errors.max() < 0.01
    aside = evaluate_tower(LabelTower(made, shifted=0.01), made)["red cube"]  # type: ignore[arg-type]
    assert len(aside.errors) == 2 and 0.5 < np.median(aside.errors) < 2
    distant = evaluate_tower(LabelTower(made, shifted=0.2), made)["red cube"]  # type: ignore[arg-type]
    assert (len(distant.errors), distant.reports) == (0, 2)
    blind = evaluate_tower(LabelTower(made, only=BUTTON), made)  # type: ignore[arg-type]
    assert "| red cube | 2 | 0 % |  | 0 % |" in report(
        blind
    ) and "| button | 1 | 100 % | 0.0 cm | 0 % |" in report(blind)


def test_one_report_between_two_objects_finds_one() -> None:
    assert match(np.array([[2.5], [2.0]])) == [2.0]
    assert match(np.array([[0.5, 1.0], [0.2, 4.0]])) == [0.2, 1.0]


def test_an_interrupted_training_ends_in_the_same_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = Scenes.load([save_scene(tmp_path / "a.npz")])
    settings = PretrainSettings(steps=4, batch_size=2, save_every=2)
    full = pretrain(fresh_tower(TINY, 0), scenes, tmp_path / "full", settings).read_bytes()
    batch_loss = pretraining._batch_loss

    def interrupt(*args: Any) -> Tensor:
        if args[-1] == 3:
            raise KeyboardInterrupt
        return batch_loss(*args)

    monkeypatch.setattr(pretraining, "_batch_loss", interrupt)
    with pytest.raises(KeyboardInterrupt):
        pretrain(fresh_tower(TINY, 0), scenes, tmp_path / "parts", settings)
    monkeypatch.undo()
    weights = pretrain(fresh_tower(TINY, 0), scenes, tmp_path / "parts", settings)
    assert weights.read_bytes() == full


def test_the_loss_leads_to_the_labels(tmp_path: Path) -> None:
    made = Scenes.load([save_scene(tmp_path / "a.npz")])
    presence, places = label_cells(made.owners, made.classes, made.places, (2, 8))
    tower, weights = fresh_tower(TINY, 0), made.weights()[0]
    optimizer = torch.optim.AdamW(tower.parameters(), 1e-2)
    for _ in range(60):
        loss = tower_loss(*tower.locate(to_unit_range(made.images)), presence, places, weights)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    results = evaluate_tower(tower, made)
    assert len(results["red cube"].errors) == 2 and len(results["button"].errors) == 1


def record(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, buildable: set[int], *words: str
) -> Any:
    def take(folder: Path, task: str, seed: int, level: str, arrangements: int, size: int) -> Path:
        if seed - 9_000_000 not in buildable:
            raise SceneError(f"{task}, seed {seed}: target 3 finds no place.")
        return folder / f"{task}-{seed}-{arrangements}.npz"

    monkeypatch.setattr(scenes, "record_scene", take)

    groups: list[list[str]] = []

    def load(files: list[Path]) -> None:
        groups.append([file.name for file in files])

    monkeypatch.setattr(vision_pretrain, "Scenes", SimpleNamespace(load=load))
    monkeypatch.setattr(vision_pretrain, "pretrain", lambda *_: None)
    monkeypatch.setattr(vision_pretrain, "evaluate_tower", lambda *_: {})
    words = ("tasks=[StopCube]", "scenes=4", "held_out=1", "workers=1", *words)
    config = resolved(compose("vision_pretrain", [*words, f"output={tmp_path}"]))
    run(read_section(PretrainRun, config, others=True))
    return groups


def test_the_last_scenes_of_a_task_are_held_out_and_only_demonstrated(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, "mme_vla.nano"):
        learned, held_out = record(monkeypatch, tmp_path, {0, 2, 3}, "arrangements=5")
    assert learned == ["StopCube-9000000-5.npz", "StopCube-9000002-5.npz"] and held_out == [
        "StopCube-9000003-0.npz"
    ]
    assert "left out: StopCube, seed 9000001" in caplog.text


def test_without_any_scene_it_says_what_to_change(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with pytest.raises(
        UserError, match="None of the 4 scenes can be built: change first_seed=9000000"
    ):
        record(monkeypatch, tmp_path, set())
    with pytest.raises(UserError, match="held_out=4: must be less than scenes=4"):
        record(monkeypatch, tmp_path, {0}, "held_out=4")


def test_the_shipped_tower_finds_what_a_scene_shows(tmp_path: Path) -> None:
    """A scene that it was not trained on: most objects, and no other ones."""
    from mme_vla.extras.nano.tower import load_shipped

    made = Scenes.load([scenes.record_scene(tmp_path, "SwingXtimes", 9_500_000, "medium", 0, 128)])
    tower = fresh_tower(TowerConfig(layout="places"), 0)
    load_shipped(tower, "places")
    results = evaluate_tower(tower, made)
    places = sum(result.places for result in results.values())
    assert sum(len(result.errors) for result in results.values()) >= 0.9 * places > 50
    assert np.median(np.concatenate([result.errors for result in results.values()])) < 1
