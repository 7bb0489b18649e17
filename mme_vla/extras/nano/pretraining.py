"""Pretraining of the nano backbone's vision tower on rendered scenes: which objects are where.

For each cell of an image and each class the tower says whether an object's centre is near, and
where. The labels are those of `scenes.py`.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone.pi05 import initialise
from mme_vla.data.console import progress
from mme_vla.embodiment.robomme import SIDE
from mme_vla.envs.grounding import project
from mme_vla.envs.observations import INTRINSIC, front_extrinsic
from mme_vla.errors import require
from mme_vla.extras.nano.tower import CLASSES, FLOOR, PlaceTower, TowerConfig
from mme_vla.types import to_unit_range
from mme_vla.utils import write_atomically
from mme_vla.weights.torch_files import load_torch_file

logger = logging.getLogger(__name__)
EMPTY = -5.0  # logit of presence in a fresh tower
POSITIVE = 2.0  # weight of a cell that shows an object, before those of classes
SHIFT = 6  # pixels that an image is moved by at most
PLACE_WEIGHT = 2.0  # of the error of places, in cells, beside that of presences
BATCH = 64  # images that are evaluated together
VOTES = 0.5  # presences that make an object, which has four cells
APART = 0.75  # cells: nearer reports of a class are one
MATCH_DISTANCE = 3.0  # centimetres between an object and its report at most


@dataclass(frozen=True)
class PretrainSettings:
    """How the tower is pretrained.

    steps: updates.
    batch_size: images each.
    lr: peak learning rate, on a cosine to zero after a short warm-up.
    save_every: updates between two drafts.
    seed: of everything random.
    """

    steps: int = 1300
    batch_size: int = 32
    lr: float = 2e-3
    save_every: int = 100
    seed: int = 0


@dataclass(frozen=True)
class Scenes:
    """Images [n, 3, s, s] uint8, and the visible objects of all.

    owners: [m], each object's image.
    classes: [m].
    centres: [m, 3], metres in the world.
    places: [m, 2], their column and row in the image, 0 … 1.
    """

    images: Tensor
    owners: Tensor
    classes: Tensor
    centres: np.ndarray
    places: Tensor

    @classmethod
    def load(cls, files: Sequence[Path]) -> "Scenes":
        """Read recorded scenes."""
        require(files, "There is no recorded scene to learn from.")
        images = []
        rows = []
        count = 0
        for file in files:
            with np.load(file) as scene:
                images.append(torch.from_numpy(scene["images"]).permute(0, 3, 1, 2))
                rows.append(scene["places"] + np.array([count, 0, 0, 0, 0], np.float32))
            count += len(images[-1])
        table = np.concatenate(rows)
        pixels = np.stack([project(centre)[::-1] for centre in table[:, 2:]]) / SIDE
        return cls(
            torch.cat(images),
            torch.from_numpy(table[:, 0].astype(np.int64)),
            torch.from_numpy(table[:, 1].astype(np.int64)),
            table[:, 2:],
            torch.from_numpy(pixels.astype(np.float32)),
        )

    def weights(self) -> tuple[Tensor, Tensor]:
        """How much each class counts in the loss, and how often each image is to be learned: what
        is rare, more.
        """
        counts = torch.bincount(self.classes, minlength=len(CLASSES)).float()
        classes = (counts.clamp(min=1) / counts.max()).rsqrt().clamp(max=8)
        images = torch.zeros(len(self.images)).scatter_reduce(
            0, self.owners, classes[self.classes], "amax"
        )
        return classes, images.clamp(min=1)

    def rows(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """The objects of a batch of images [b]: each one's place in the batch, and its
        row in here.
        """
        batch, rows = (images[:, None] == self.owners).nonzero().unbind(1)
        return batch, rows


def fresh_tower(config: TowerConfig, seed: int) -> PlaceTower:
    """A tower with random weights that reports nothing yet."""
    torch.manual_seed(seed)
    tower = PlaceTower(config.widths, config.blocks, config.in_use)
    initialise(tower)
    nn.init.constant_(tower.out.bias[: len(CLASSES)], EMPTY)  # type: ignore[index]  # it has a bias
    return tower


def label_cells(
    batch: Tensor, classes: Tensor, places: Tensor, shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """What the tower should say: presence [b, K, g, g], 0 or 1, and places [b, K, 2, g, g] from
    each cell's centre.

    An object is present in the cells whose centres are less than a cell away along both axes. Where
    two of a class are near, the nearer one counts.

    Args:
        batch: each object's image.
        classes: [m].
        places: column and row in the image [m, 2], 0 … 1.
        shape: images b and cells g a side.
    """
    images, side = shape
    presence = torch.zeros(images, len(CLASSES), side, side)
    offsets = torch.zeros(images, len(CLASSES), 2, side, side)
    nearest = torch.full_like(presence, math.inf)
    where = places * side - 0.5  # in cells, from the first one's centre
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        cell = where.floor().long() + torch.tensor(corner)
        inside = ((cell >= 0) & (cell < side)).all(1)
        for image, kind, (column, row), offset in zip(
            batch[inside].tolist(),
            classes[inside].tolist(),
            cell[inside].tolist(),
            (where - cell)[inside],
            strict=True,
        ):
            distance = offset.square().sum()
            if distance < nearest[image, kind, row, column]:
                nearest[image, kind, row, column] = distance
                presence[image, kind, row, column] = 1
                offsets[image, kind, :, row, column] = offset
    return presence, offsets


def augmented(
    images: Tensor, places: Tensor, batch: Tensor, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """A batch moved by the same few pixels, the edges repeated, and each image mirrored half of the
    time.

    Args:
        images: [b, 3, s, s].
        places: [m, 2] in them, of the images `batch` [m].
    """
    right, down = rng.integers(-SHIFT, SHIFT + 1, 2).tolist()
    side = images.shape[-1]
    padded = functional.pad(images, (SHIFT,) * 4, mode="replicate")
    shifted = padded[..., SHIFT - down : SHIFT - down + side, SHIFT - right : SHIFT - right + side]
    places = places + torch.tensor([right, down]) / side
    mirrored = torch.from_numpy(rng.random(len(images)) < 0.5)
    shifted = torch.where(mirrored[:, None, None, None], shifted.flip(-1), shifted)
    return shifted, torch.where(
        mirrored[batch][:, None], torch.stack([1 - places[:, 0], places[:, 1]], 1), places
    )


def tower_loss(
    logits: Tensor, offsets: Tensor, presence: Tensor, places: Tensor, weights: Tensor
) -> Tensor:
    """Binary cross-entropy of presences, and the absolute error of places where an object is, per
    labelled cell.

    Args:
        logits, offsets: of `PlaceTower.locate`.
        presence, places: of `label_cells`.
        weights: of the classes [K].
    """
    each = weights[:, None, None] * (1 + (POSITIVE - 1) * presence)
    cross_entropy = functional.binary_cross_entropy_with_logits(
        logits, presence, each, reduction="sum"
    )
    labelled = weights[:, None, None] * presence
    error = labelled[:, :, None] * (offsets - places).abs()
    count = labelled.sum().clamp(min=1)
    return (cross_entropy + PLACE_WEIGHT * error.sum()) / count


def pretrain(
    tower: PlaceTower,
    scenes: Scenes,
    folder: Path,
    settings: PretrainSettings,
) -> Path:
    """Train a tower on recorded scenes; a run that was interrupted continues. The path of its
    weights.

    Args:
        tower: with fresh weights.
        scenes: to learn from.
        folder: of the run.
    """
    from safetensors.torch import load_file, save_file

    weights_file, draft = folder / "nano_tower.safetensors", folder / "draft.pt"
    if weights_file.is_file():
        learned = load_file(weights_file)
        tower.load_state_dict({name: value.float() for name, value in learned.items()})
        return weights_file
    folder.mkdir(parents=True, exist_ok=True)
    weights, frequencies = scenes.weights()
    tower.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in the stubs
    optimizer = torch.optim.AdamW(tower.parameters(), lr=settings.lr, weight_decay=0.01)
    start = 0
    if draft.is_file():
        state = load_torch_file(draft, "the draft of a vision tower")
        tower.load_state_dict(state["tower"])
        optimizer.load_state_dict(state["optimizer"])
        start = state["step"]
    with progress("updates", settings.steps, done=start) as advance:
        for step in range(start, settings.steps):
            scale = min(1, (step + 1) / 50) * (1 + math.cos(math.pi * step / settings.steps)) / 2
            for group in optimizer.param_groups:
                group["lr"] = settings.lr * scale
            loss = _batch_loss(tower, scenes, frequencies, weights, settings, step)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(tower.parameters(), 5.0)
            optimizer.step()
            done = step + 1
            if done % settings.save_every == 0 or done == settings.steps:
                with write_atomically(draft) as path:
                    torch.save(
                        {
                            "tower": tower.state_dict(),
                            "optimizer": optimizer.state_dict(),
                            "step": done,
                        },
                        path,
                    )
                logger.info("update %d of %d, loss %.3f", done, settings.steps, loss.item())
            advance(1)
    state = {name: value.contiguous().half() for name, value in tower.state_dict().items()}
    with write_atomically(weights_file) as path:
        save_file(state, path)
    return weights_file


def _batch_loss(
    tower: PlaceTower,
    scenes: Scenes,
    frequencies: Tensor,
    weights: Tensor,
    settings: PretrainSettings,
    step: int,
) -> Tensor:
    rng = np.random.default_rng([settings.seed, step])
    shares = (frequencies / frequencies.sum()).double().numpy()
    images = torch.from_numpy(rng.choice(len(shares), settings.batch_size, p=shares / shares.sum()))
    batch, rows = scenes.rows(images)
    pixels, places = augmented(
        to_unit_range(scenes.images[images]), scenes.places[rows], batch, rng
    )
    logits, offsets = tower.locate(pixels.contiguous(memory_format=torch.channels_last))
    presence, where = label_cells(
        batch, scenes.classes[rows], places, (len(images), logits.shape[-1])
    )
    return tower_loss(logits, offsets, presence, where, weights)


# Evaluation ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ClassResult:
    """One class on held-out scenes.

    places: visible objects.
    reports: of the class.
    errors: centimetres between each object and its report, of those that are found: an object and a
        report belong together once, the nearest first, up to `MATCH_DISTANCE`.
    """

    places: int
    reports: int
    errors: np.ndarray


def find_objects(presence: Tensor, offsets: Tensor) -> list[tuple[float, float]]:
    """Column and row, 0 … 1, of the objects that a tower reports of one class in one image.

    Cells vote for the places that they report, the surest first. Votes for nearly the same place
    are one object, at their mean, if they come to `VOTES`.

    Args:
        presence: [g, g].
        offsets: [2, g, g].
    """
    rows, columns = (presence > FLOOR).nonzero().unbind(1)
    votes, order = presence[rows, columns].sort(descending=True)
    places = (torch.stack([columns, rows], 1) + 0.5 + offsets[:, rows, columns].T)[order]
    objects: list[tuple[Tensor, Tensor]] = []  # sum of places and of votes
    for place, vote in zip(places, votes, strict=True):
        distances = [float((total / count - place).norm()) for total, count in objects]
        if distances and min(distances) < APART:
            nearest = distances.index(min(distances))
            total, count = objects[nearest]
            objects[nearest] = total + vote * place, count + vote
        else:
            objects.append((vote * place, vote))
    means = []
    for total, count in objects:
        if count >= VOTES:
            column, row = (total / count / len(presence)).tolist()
            means.append((column, row))
    return means


def on_plane(place: tuple[float, float], height: float) -> np.ndarray:
    """Where the front camera's ray through a place (column and row, 0 … 1) meets a height, x and y
    in metres.
    """
    extrinsic = front_extrinsic().astype(np.float64)
    rotation, shift = extrinsic[:, :3], extrinsic[:, 3]
    eye = -rotation.T @ shift
    ray = rotation.T @ np.linalg.solve(
        INTRINSIC.astype(np.float64), [place[0] * SIDE, place[1] * SIDE, 1.0]
    )
    point: np.ndarray = (eye + (height - eye[2]) / ray[2] * ray)[:2]
    return point


@torch.no_grad()
def evaluate_tower(tower: PlaceTower, scenes: Scenes) -> dict[str, ClassResult]:
    """What a tower finds in scenes that it did not learn from, class by class.

    A report is compared with objects in the horizontal plane through their centres, in centimetres.
    """
    # What it reports in each image: a list of places for each class
    reports: list[list[list[tuple[float, float]]]] = []
    for start in range(0, len(scenes.images), BATCH):
        logits, offsets = tower.locate(to_unit_range(scenes.images[start : start + BATCH]))
        for presence, places in zip(logits.sigmoid(), offsets, strict=True):
            reports.append([find_objects(*pair) for pair in zip(presence, places, strict=True)])

    results = {}
    for number, name in enumerate(CLASSES):
        errors: list[float] = []
        n_reported = 0
        rows = (scenes.classes == number).nonzero()[:, 0]
        for image, report in enumerate(reports):
            places = report[number]
            n_reported += len(places)
            centres = scenes.centres[rows[scenes.owners[rows] == image].numpy()]
            distances = np.zeros((len(centres), len(places)))
            for row, (x, y, z) in enumerate(centres):
                for column, place in enumerate(places):
                    distances[row, column] = np.linalg.norm(on_plane(place, z) - (x, y))
            errors += match(100 * distances)
        results[name] = ClassResult(len(rows), n_reported, np.array(errors))
    return results


def match(distances: np.ndarray) -> list[float]:
    """The distances, up to `MATCH_DISTANCE`, of pairs of a row and a column, the nearest first,
    each in one pair.
    """
    errors: list[float] = []
    while distances.size and distances.min() <= MATCH_DISTANCE:
        row, column = np.unravel_index(distances.argmin(), distances.shape)
        errors.append(float(distances[row, column]))
        distances = np.delete(np.delete(distances, row, 0), column, 1)
    return errors


def report(results: dict[str, ClassResult]) -> str:
    """The results as rows of a Markdown table, those of classes that have places."""
    lines = [
        "| class | places | found | median error | wrong reports |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, result in results.items():
        if result.places:
            detected, wrong = len(result.errors), result.reports - len(result.errors)
            median = f"{np.median(result.errors):.1f} cm" if detected else ""
            shares = 100 * detected / result.places, 100 * wrong / max(result.reports, 1)
            lines.append(
                f"| {name} | {result.places} | {shares[0]:.0f} % | {median} | {shares[1]:.0f} % |"
            )
    return "\n".join(lines)
