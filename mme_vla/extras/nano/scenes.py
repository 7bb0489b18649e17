"""Images of the sixteen tasks with what is where in them: what the small vision tower learns to see
from.

A scene is demonstrated once, and rendered at steps of every state that occurs: something held,
pressed, marked or highlighted. Then its objects, the arm and the gripper are put somewhere else for
each further image, without simulation. Labels come from the simulator's poses, and from its
segmentation, which says what is visible.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import sapien

from mme_vla.embodiment.robomme import SIDE
from mme_vla.envs.grounding import project
from mme_vla.envs.make import make_task
from mme_vla.envs.observations import RenderRequest, capture, read_images
from mme_vla.envs.robomme.recording.recorder import Recorder
from mme_vla.envs.robomme.robot.kinematics import Arm
from mme_vla.envs.robomme.scene.articulated import Button, Peg
from mme_vla.envs.robomme.scene.motions import Highlight
from mme_vla.envs.robomme.scene.objects import (
    BELOW_TABLE,
    COLOURS,
    Board,
    Container,
    Cube,
    Disc,
)
from mme_vla.envs.robomme.scene.predicates import pressed
from mme_vla.envs.robomme.scene.things import AWAY, UNDER_THE_FLOOR, Thing, distance_xy
from mme_vla.extras.nano.tower import CLASSES
from mme_vla.processing.images import resize_with_pad_uint8
from mme_vla.utils import write_atomically

if TYPE_CHECKING:
    from mme_vla.envs.task import Task

CLEAR_COLOUR = 0.35
"""How far the strongest channel of a cube's colour (0 … 1) stands out where the cube counts as red,
green or blue.
"""
VISIBLE_PIXELS = 16
"""Of a 256 × 256 image: with fewer an object counts as hidden."""
IN_HAND, GRASP = 0.03, (0.004, 0.03)
"""Metres from the tool's centre to a held object's, and between which a finger is then."""
UNDER_MARK = 0.01  # metres between a disc and the mark that covers it, at most
FIRST_STEP = 3  # of a state, at which it is rendered; then at twice the step before
_OF_A_STATE = ("pressed", "mark", "highlight", "held", "other held")
STATES = frozenset(name for name in CLASSES if name.startswith(_OF_A_STATE))


class Place(NamedTuple):
    """One object in a scene: the number of its class, its centre in the world [3], and its ids in a
    segmentation.
    """

    number: int
    centre: np.ndarray
    ids: Sequence[int]


def find_places(env: "Task") -> list[Place]:
    """The class and the place of everything in a scene, visible or not."""
    places = []
    for name, centre, ids in _named_places(env):
        places.append(Place(CLASSES.index(name), np.asarray(centre, np.float64), ids))
    return places


def _named_places(env: "Task") -> Iterator[tuple[str, np.ndarray, list[int]]]:
    yield "hand", env.tcp_pose.p, [int(link.per_scene_id[0]) for link in env.agent.robot.links]
    # Discs that mark or highlight something now; they are no things of a task.
    lit = []
    for name, actor in env.scene.actors.items():
        kind = "highlight" if name.startswith("highlight") else "mark"
        if name.startswith(("highlight", "mark", "disc_red")):
            disc = Thing(name, actor)
            if disc.position[2] > UNDER_THE_FLOOR:
                lit.append((kind, disc))
    lit_discs = [disc for _, disc in lit]
    is_grasping = GRASP[0] < float(env.fingers.mean()) < GRASP[1]
    for thing in env.things:
        name = _class_of(thing)
        parts = (thing.head, thing.tail) if isinstance(thing, Peg) else (thing,)
        for part in parts:
            position = part.position
            ids = _visible_ids(part, lit_discs)
            yield name, position, ids
            if isinstance(thing, Button) and pressed(thing):
                yield "pressed button", position, ids
            is_near = float(np.linalg.norm(position - env.tcp_pose.p)) < IN_HAND
            if is_grasping and is_near and name.endswith(("cube", "container", "peg end")):
                class_name = f"held {name}"
                if class_name not in CLASSES:
                    class_name = "other held object"
                yield class_name, position, ids
    for name, disc in lit:
        yield name, disc.position, disc.segmentation_ids


def _visible_ids(thing: Any, lit: Sequence[Any]) -> list[int]:
    """The ids of what shows where a thing is: of a button both parts, of a disc also the mark that
    covers it.
    """
    ids: list[int] = thing.segmentation_ids
    if isinstance(thing, Button):
        return ids + [int(link.per_scene_id[0]) for link in thing.articulation.links]
    if isinstance(thing, Disc):
        for mark in lit:
            if distance_xy(mark.position, thing.position) < UNDER_MARK:
                ids = ids + mark.segmentation_ids
    return ids


def _class_of(thing: Any) -> str:
    if isinstance(thing, Cube):
        colour = thing.colour
        if isinstance(colour, str):
            colour = COLOURS[colour]
        second, first = np.sort(colour)[-2:]
        if first - second <= CLEAR_COLOUR:
            return "other cube"
        return ("red cube", "green cube", "blue cube")[np.argmax(colour)]
    if isinstance(thing, Disc):
        return "disc" if thing.name.startswith("disc") else "target"
    types = {Container: "container", Button: "button", Board: "board", Peg: "peg end"}
    return types.get(type(thing)) or thing.name.partition("_")[0]  # box, obstacle


def visible_places(places: Sequence[Place], segmentation: np.ndarray) -> np.ndarray:
    """The places [m, 4] (class, x, y, z) whose objects show enough pixels in an image that holds
    their centre.
    """
    largest_id = max(max(place.ids) for place in places)
    counts = np.bincount(segmentation.ravel(), minlength=1 + largest_id)
    rows = []
    for number, centre, ids in places:
        pixel = project(centre)
        is_inside = (pixel >= 0).all() and (pixel < SIDE).all()
        if is_inside and counts[list(set(ids))].sum() >= VISIBLE_PIXELS:
            rows.append([number, *centre])
    return np.array(rows, np.float32).reshape(-1, 4)


class Renders:
    """Images of one scene, and the visible places of each."""

    def __init__(self, env: "Task", size: int) -> None:
        self._env, self._size = env, size
        self.images: list[np.ndarray] = []
        self.places: list[np.ndarray] = []  # frame, class, x, y, z
        self._steps: Counter[tuple[int, ...]] = Counter()
        self._next: dict[tuple[int, ...], int] = {}

    def take(self, places: Sequence[Place] | None = None) -> None:
        """Render the scene as it is now."""
        capture(self._env, ["front"])
        taken = read_images(self._env, "front", rgb=True, segmentation=True)
        visible = visible_places(places or find_places(self._env), taken["segmentation"][..., 0])
        self.places.append(np.insert(visible, 0, len(self.images), axis=1))
        self.images.append(resize_with_pad_uint8(taken["rgb"], self._size))

    def step(self, *_: object) -> None:
        """Render a step of a demonstration, if its state has not been seen for so many steps."""
        places = find_places(self._env)
        state = tuple(sorted(place.number for place in places if CLASSES[place.number] in STATES))
        self._steps[state] += 1
        if self._steps[state] >= self._next.get(state, FIRST_STEP):
            self._next[state] = 2 * self._steps[state]
            self.take(places)


def record_scene(
    folder: Path, task: str, seed: int, difficulty: str, arrangements: int, size: int
) -> Path:
    """Render a scene into `folder`, unless it is there already; the path of its file.

    The file has `images` [n, size, size, 3] uint8 and `places` [m, 5]: the image, the class and the
    centre (metres in the world) of every visible object.

    Args:
        arrangements: images with everything put elsewhere, behind those of the demonstration.
    """
    path = folder / f"{task}-{difficulty}-{seed}.npz"
    if path.is_file():
        return path
    env = make_task(task, render=True, seed=seed, difficulty=difficulty)
    try:
        renders = Renders(env, size)
        Recorder(
            env, on_step=renders.step, render_request=RenderRequest(now=(), grounded=False)
        ).record()
        if arrangements:
            env.reset()
        arm = Arm(env.agent)
        rng = np.random.default_rng(seed)
        for _ in range(arrangements):
            _arrange(env, arm, rng)
            renders.take()
        with write_atomically(path) as draft, draft.open("wb") as file:
            np.savez_compressed(
                file, images=np.stack(renders.images), places=np.concatenate(renders.places)
            )
    finally:
        env.close()
    return path


def _arrange(env: "Task", arm: Any, rng: np.random.Generator) -> None:
    """Put what can be put elsewhere, mark and highlight some of it, and move the arm, perhaps with
    something held.
    """
    import torch

    for thing in env.things:
        _relocate(thing, rng)
    _light(env, rng)
    near = [thing for thing in env.things if np.abs(thing.position).max() < 0.5]
    place = np.array([rng.uniform(-0.25, 0.2), rng.uniform(-0.28, 0.28), rng.uniform(0.03, 0.35)])
    over = near[rng.integers(len(near))] if near and rng.random() < 0.6 else None
    if over is not None:
        place = over.position + np.array([0, 0, rng.uniform(0.01, 0.2)])
    target = _pose(place) * _yaw_pose(rng.uniform(-0.8, 0.8)) * _pose(q=(0, 1, 0, 0))
    joints = arm.ik(target, env.qpos)
    if joints is None:
        return
    grasped = not env.stick and over is not None and rng.random() < 0.5
    grasped = grasped and _class_of(over).endswith(("cube", "container"))
    fingers: list[float] = []
    if not env.stick:
        width = rng.uniform(0.014, 0.021) if grasped else rng.uniform(0.03, 0.04)
        fingers = [width, width]
    env.agent.robot.set_qpos(torch.as_tensor(np.append(joints, fingers), dtype=torch.float32)[None])
    if grasped and over is not None:
        over.move_to(_pose(env.tcp_pose.p, over.pose.q))


def _relocate(thing: Any, rng: np.random.Generator) -> None:
    """Turned and, three times of ten, where it was; now and then lifted; containers out of the way
    half of the time.
    """
    name = _class_of(thing)
    home = thing.initial_pose
    if name == "container" and rng.random() < 0.5:
        return thing.move_to(_pose(AWAY, thing.pose.q))
    if rng.random() < 0.3:
        return thing.move_to(home)
    lifted = rng.uniform(0, 0.15) if "cube" in name and rng.random() < 0.2 else 0.0
    place = (rng.uniform(-0.25, 0.2), rng.uniform(-0.28, 0.28), home.p[2] + lifted)
    thing.move_to(_pose(place, (_yaw_pose(rng.uniform(-np.pi, np.pi)) * _pose(q=home.q)).q))


def _light(env: "Task", rng: np.random.Generator) -> None:
    """Marks over some targets and discs, highlights under some cubes; the others out of the way."""
    bases: dict[str, list[Thing]] = {"highlight": [], "mark": []}
    for thing in env.things:
        name = _class_of(thing)
        if "cube" in name or name in ("target", "disc"):
            bases["highlight" if "cube" in name else "mark"].append(thing)
    for name, actor in env.scene.actors.items():
        among = bases.get(name.partition("_")[0])
        if among:
            disc = Thing(name, actor)
            position = np.array(BELOW_TABLE)
            if rng.random() > 0.6:
                position = among[rng.integers(len(among))].position - [0, 0, Highlight.DEPTH]
            disc.move_to(_pose(position, disc.pose.q))


def _pose(p: Any = (0, 0, 0), q: Any = (1, 0, 0, 0)) -> Any:
    return sapien.Pose(p, q)


def _yaw_pose(yaw: float) -> Any:
    return _pose(q=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)))
