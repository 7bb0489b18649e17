"""A vision tower for MIKASA-Robo-VLA with two CPU cores, as nanoMME has one for RoboMME: trained on
renders of the train split's last scenes to say which colours and shapes are where.

python benchmarks/mikasa_tower.py --output outputs/mikasa24/tower --tasks RememberShape9 TakeItBack

`benchmarks/mikasa_table.py` does it as its first step.
"""

import argparse
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch

from mme_vla.config.composition import compose, resolved
from mme_vla.config.sections import read_section
from mme_vla.data.console import progress
from mme_vla.envs.base import environment
from mme_vla.extras.mikasa.environment import CAMERAS, MikasaScene
from mme_vla.extras.nano.pretraining import PretrainSettings, Scenes, fresh_tower, pretrain
from mme_vla.extras.nano.tower import CLASSES, PlaceTower, TowerConfig
from mme_vla.policy.build import build_from_config
from mme_vla.utils import write_atomically

ENV = "mikasa_choices"
CAMERA = "wrist"
ATTRIBUTES = (
    "red", "lime", "blue", "yellow", "magenta", "cyan", "maroon", "olive", "teal",
    "cube", "sphere", "cylinder", "cross", "torus", "star",
    "pyramide",  # codespell:ignore pyramide
    "t_shape", "crescent",
)  # fmt: skip
"""What the tower locates, in place of RoboMME's classes: each colour and each shape."""
HIDDEN = 1.0  # metres above the table: what is not shown is far beyond
BACKBONE = ("backbone=nano_choice", "backbone.point=regression", "backbone.vision.in_use=1.0")


def views(scene: MikasaScene) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """The cue, and the table when the answer can be given, of a scene that was just reset.

    Yields:
        An image [128, 128, 3], and rows [m, 3] of what it shows: number of the attribute, column
        and row in the image, 0 … 1.
    """
    observation = scene.observe()
    yield observation[CAMERA](), _labels(scene)
    if not scene.cue_end:
        return
    while scene.time < scene.cue_end:
        observation, *_ = scene.step(np.zeros(7))
    yield observation[CAMERA](), _labels(scene)


def _labels(scene: MikasaScene) -> np.ndarray:
    camera = scene.scene.scene.sensors[CAMERAS[CAMERA]].camera
    extrinsic = camera.get_extrinsic_matrix()[0].numpy()
    intrinsic = camera.get_intrinsic_matrix()[0].numpy()
    rows = []
    for name, thing in scene.scene_facts.things().items():
        place = thing.pose.p[0].numpy()
        if place[2] > HIDDEN:
            continue
        x, y, depth = intrinsic @ (extrinsic @ [*place, 1.0])
        column, row = np.array([x, y]) / depth / 128
        if depth > 0 and 0 <= column < 1 and 0 <= row < 1:
            rows += [(ATTRIBUTES.index(word), column, row) for word in name.split()]
    return np.array(rows, np.float32).reshape(-1, 3)


def render_task(task: str, folder: Path, count: int) -> Path:
    """Render the last scenes of a task's train split into a file, if it is not there."""
    path = folder / f"{task}.npz"
    if path.is_file():
        return path
    source = environment(ENV)
    scene: MikasaScene | None = None
    images, rows = [], []
    for spec in source.episodes(task, "train")[-count:]:
        scene = scene or source.make(spec)
        scene.reset(seed=spec.seed)
        for image, labels in views(scene):
            numbers = np.full((len(labels), 1), len(images), np.float32)
            rows.append(np.concatenate([numbers, labels], 1))
            images.append(image)
    if scene is not None:
        scene.close()
    with write_atomically(path) as draft, draft.open("wb") as file:
        np.savez_compressed(file, images=np.stack(images), rows=np.concatenate(rows))
    return path


def load(files: Sequence[Path]) -> Scenes:
    """All rendered scenes."""
    images, rows = [], []
    count = 0
    for path in files:
        with np.load(path) as stored:
            images.append(stored["images"])
            rows.append(stored["rows"] + np.array([count, 0, 0, 0], np.float32))
        count += len(images[-1])
    pixels = torch.from_numpy(np.concatenate(images)).permute(0, 3, 1, 2)
    table = torch.from_numpy(np.concatenate(rows))
    owners, classes = table[:, 0].long(), table[:, 1].long()
    # Places in the world only measure a tower, which nothing does here.
    return Scenes(pixels, owners, classes, np.zeros((len(table), 3)), table[:, 2:])


def make_tower(tasks: Sequence[str], folder: Path, count: int, steps: int, jobs: int) -> PlaceTower:
    """A tower that was trained on renders of these tasks; what the folder holds already stays."""
    assert len(ATTRIBUTES) <= len(CLASSES)
    scenes = folder / "scenes"
    scenes.mkdir(parents=True, exist_ok=True)
    files = []
    render = partial(render_task, folder=scenes, count=count)
    with ProcessPoolExecutor(jobs) as pool, progress("scenes", len(tasks), unit="tasks") as advance:
        for file in pool.map(render, tasks):
            files.append(file)
            advance(1)
    vision = resolved(compose("policy", [f"env={ENV}", *BACKBONE]).backbone.vision)
    tower = fresh_tower(read_section(TowerConfig, vision, "backbone.vision"), 0)
    pretrain(tower, load(files), folder, PretrainSettings(steps=steps))
    return tower


def save_initial_policy(tower: PlaceTower, folder: Path, seed: int) -> None:
    """Save a fresh policy with this tower, from which trainings begin (`init_from`)."""
    policy = build_from_config(
        compose("policy", ["model=pi05", f"env={ENV}", *BACKBONE]), seed=seed
    )
    policy.model.backbone.vision.load_state_dict(tower.state_dict())
    policy.save_pretrained(folder)


def main(words: Sequence[str] | None = None) -> None:
    """Render the scenes that are missing, and train the tower."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", required=True)
    parser.add_argument("--scenes", type=int, default=150, help="of each task")
    parser.add_argument("--steps", type=int, default=400, help="updates")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args(words)
    make_tower(args.tasks, args.output, args.scenes, args.steps, args.jobs)


if __name__ == "__main__":
    main()
