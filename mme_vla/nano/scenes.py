"""Images of the sixteen tasks with what is where in them: what the small vision tower learns to see from.

Nothing is simulated: a scene is built once, and for each image its objects, the arm and the gripper are put somewhere
else. Segmentation says which object every pixel shows, so labels cost nothing.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mme_vla.backbone.nano_vision import CLASSES
from mme_vla.embodiment.robomme import CAMERAS
from mme_vla.envs.make import make_task
from mme_vla.envs.observations import capture, read_images
from mme_vla.processing.images import resize_with_pad_uint8
from mme_vla.utils import write_atomically

if TYPE_CHECKING:
    from mme_vla.envs.task import Task

_BY_NAME = {
    "container": "container", "button": "button", "target": "target", "spot": "target", "disc": "disc",
    "board": "box", "box": "box", "obstacle": "obstacle", "peg": "peg",
}  # fmt: skip
LABEL_SIDE = 64  # Labels have a number for each of 64×64 places of an image
_CUBES = ("red cube", "green cube", "blue cube")
_CLEAR_COLOUR = 60  # of 255: how far a cube's strongest channel stands out where it has one


def draw_scene(task: str, seed: int, difficulty: str, count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Images of one scene, differently arranged each time.

    count: arrangements; each gives an image of the front camera and one of the wrist's. size: side of the images.

    Returns:
        images [2·count, size, size, 3] uint8, and labels [2·count, 64, 64] uint8: places in `CLASSES`.
    """
    from mme_vla.envs.robot.kinematics import Arm

    env = make_task(task, render=True, seed=seed, difficulty=difficulty)
    try:
        env.reset()
        arm, rng = Arm(env.agent), np.random.default_rng(seed)
        owners = _owners(env)
        images, labels = [], []
        for _ in range(count):
            _arrange(env, arm, rng)
            capture(env, CAMERAS)
            for camera in CAMERAS:
                taken = read_images(env, camera, rgb=True, segmentation=True)
                images.append(resize_with_pad_uint8(taken["rgb"], size))
                labels.append(_label(taken["rgb"], taken["segmentation"][..., 0], owners))
        return np.stack(images), np.stack(labels)
    finally:
        env.close()


def record_scenes(folder: Path, task: str, seed: int, difficulty: str, count: int, size: int) -> Path:
    """Draw a scene into `folder`, unless it is there already; the path of its file."""
    path = folder / f"{task}-{difficulty}-{seed}.npz"
    if not path.is_file():
        images, labels = draw_scene(task, seed, difficulty, count, size)
        with write_atomically(path) as draft, draft.open("wb") as file:
            np.savez_compressed(file, pictures=images, labels=labels)
    return path


def _owners(env: "Task") -> dict[int, str]:
    """Segmentation id → what the object is called, of everything that is not background."""
    owners: dict[int, str] = {}
    for thing in env.things:
        for number in thing.segmentation_ids:
            owners[number] = thing.name
        articulation = getattr(thing.entity, "articulation", None)
        for link in () if articulation is None else articulation.links:
            owners[int(link.per_scene_id[0])] = thing.name
    return owners | {int(link.per_scene_id[0]): "robot" for link in env.agent.robot.links}


def _arrange(env: "Task", arm: Any, rng: np.random.Generator) -> None:
    """Put what can move, and the arm, somewhere else; half of the time containers are out of the way."""
    import sapien
    import torch

    covered = rng.random() < 0.5
    for thing in env.things:
        if getattr(thing.entity, "px_body_type", "") != "dynamic":
            continue
        home = thing.initial_pose
        if thing.name.startswith("container") and not covered:
            thing.move_away()
            continue
        lifted = rng.uniform(0, 0.15) if rng.random() < 0.2 else 0.0
        place = np.array([rng.uniform(-0.25, 0.2), rng.uniform(-0.28, 0.28), home.p[2] + lifted])
        thing.move_to(sapien.Pose(place, (_yaw_pose(rng.uniform(-np.pi, np.pi)) * sapien.Pose(q=home.q)).q))
    if rng.random() < 0.2:
        env.agent.robot.set_qpos(torch.as_tensor(_home_qpos(env), dtype=torch.float32)[None])
        return
    near = [thing.position for thing in env.things if abs(thing.position[0]) < 0.5 and thing.position[2] > -0.05]
    place = np.array([rng.uniform(-0.25, 0.2), rng.uniform(-0.28, 0.28), rng.uniform(0.03, 0.35)])
    if near and rng.random() < 0.6:
        place = near[rng.integers(len(near))] + [0, 0, rng.uniform(0.01, 0.2)]
    down = sapien.Pose(q=[0, 1, 0, 0])
    joints = arm.ik(sapien.Pose(place) * _yaw_pose(rng.uniform(-0.8, 0.8)) * down, env.qpos)
    if joints is not None:
        fingers = [] if env.stick else [rng.uniform(0.0, 0.04)] * 2
        env.agent.robot.set_qpos(torch.as_tensor(np.append(joints, fingers), dtype=torch.float32)[None])


def _yaw_pose(yaw: float) -> Any:
    import sapien

    return sapien.Pose(q=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])


def _home_qpos(env: "Task") -> np.ndarray:
    return env.reset_action if env.stick else np.append(env.reset_action[:7], [0.04, 0.04])


def _label(image: np.ndarray, segments: np.ndarray, owners: dict[int, str]) -> np.ndarray:
    label = np.zeros(segments.shape, np.uint8)
    for number in np.unique(segments):
        name = owners.get(int(number))
        if name is not None:
            mask = segments == number
            label[mask] = CLASSES.index(_class_of(name, image[mask]))
    step = len(label) // LABEL_SIDE
    return label[step // 2 :: step, step // 2 :: step]


def _class_of(name: str, pixels: np.ndarray) -> str:
    """The class of an object by its name; of a cube by its colour, as far as it is one of three."""
    kind = name.partition("_")[0]
    if kind != "cube":
        return name if name == "robot" else _BY_NAME[kind]
    colour = np.median(pixels, axis=0)
    first, second = np.sort(colour)[::-1][:2]
    return _CUBES[int(colour.argmax())] if first - second > _CLEAR_COLOUR else "other cube"
