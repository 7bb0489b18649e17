"""Demonstrations of MIKASA-Robo-VLA: scripts that read the simulator's state and move the hand.

Each is a generator of actions [7]; `env.step` is called between two of them, so positions are read
anew for each.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from mme_vla.errors import require

REACH = 0.1  # metres, and radians, that an action of 1 moves the hand
OPEN, CLOSED = 1.0, -1.0
_STEP_SECONDS = 0.05  # of one control step
_SETTLE_STEPS = 5  # in which cups come to lie over the ball

Actions = Iterator[np.ndarray]


def demonstrate(env: Any) -> Actions:
    """Solve the episode of an environment, just reset; the last action repeats until it is over.

    Raises:
        UserError: there is no script for its task. The hand has waited until the answer can be
            given, which is all that twins need.
    """
    name = type(env.scene).__name__
    scripts = [script for beginning, script in _SCRIPTS.items() if name.startswith(beginning)]
    hand = Hand(env.scene)
    while env.time < env.cue_end:
        yield hand.action(gripper=OPEN)
    if not scripts:
        yield from hand.hold(_SETTLE_STEPS, OPEN)
    require(scripts, f"There is no script that demonstrates {name}.")
    yield from scripts[0](hand)
    while True:
        yield hand.action(gripper=hand.gripper)


class Hand:
    """The hand of a scene: where it is, and the action that brings it closer to a place."""

    def __init__(self, scene: Any) -> None:
        self.scene = scene
        self.gripper = OPEN
        """The last command."""

    @property
    def position(self) -> np.ndarray:
        """Of the point between the fingers [3], metres."""
        return place_of(self.scene.agent.tcp)

    @property
    def yaw(self) -> float:
        """Angle of the axis along which the fingers open, about the vertical, radians."""
        matrix = self.scene.agent.tcp.pose.to_transformation_matrix()[0].cpu().numpy()
        return float(np.arctan2(matrix[1, 1], matrix[0, 1]))

    def action(
        self, motion: Any = (0, 0, 0), turned: float = 0.0, gripper: float | None = None
    ) -> np.ndarray:
        """Displace the hand by `motion` [3] metres and turn it by `turned` radians about the
        vertical, as far as one action can.
        """
        if gripper is not None:
            self.gripper = gripper
        values = np.zeros(7, np.float32)
        motion = np.asarray(motion, np.float64)
        longest = np.abs(motion).max()
        if longest > REACH:
            motion = motion * (REACH / longest)
        values[:3] = motion / REACH
        values[5] = np.clip(-turned / REACH, -1, 1)  # the hand looks down
        values[6] = self.gripper
        return values

    def go(self, place: Any, within: float, gripper: float, steps: int = 40) -> Actions:
        """Move until the hand is within so many metres of a place, at most so many steps.

        place: [3], or a function that gives it anew at each step.
        """
        for _ in range(steps):
            goal = place() if callable(place) else place
            offset = np.asarray(goal) - self.position
            if np.linalg.norm(offset) < within:
                return
            yield self.action(offset, gripper=gripper)

    def hold(self, steps: int, gripper: float) -> Actions:
        """Stay for so many steps."""
        for _ in range(steps):
            yield self.action(gripper=gripper)


def place_of(thing: Any) -> np.ndarray:
    """Position of an actor or a link [3], metres."""
    position: np.ndarray = thing.pose.p[0].cpu().numpy().astype(np.float64)
    return position


def touch(hand: Hand) -> Actions:
    """Remember* and FindImposter*: touch the right object."""
    # from the hand, in the world
    return touch_thing(hand, lambda: hand.scene.obj_to_goal_pos[0].cpu().numpy())


def touch_thing(hand: Hand, offset: Callable[[], np.ndarray]) -> Actions:
    """Bring the hand over an object, so near that it counts, and stay there.

    offset: from the hand to the object [3], metres, read anew at each step.
    """
    for _ in range(_TOUCH_STEPS):
        # In every direction as fast as it goes: there are few steps
        yield hand.action(np.clip(offset() + _up(_OVER), -REACH, REACH), gripper=OPEN)


_TOUCH_STEPS = 40  # the longest of these episodes
_OVER = 0.025  # metres over the middle of an object; a touch counts within 0.05
_ABOVE_CUBE = 0.012  # metres over the point that counts, less than the radius of a touch
TRAVEL = 0.16  # height at which the hand passes over cubes and button


def touch_several(hand: Hand) -> Actions:
    """Bunch, Seq and ChainOfColors: touch the cubes one after the other, and press the button."""
    yield from hand.hold(6, CLOSED)  # cubes are put back into place for some steps
    for key in hand.scene.true_color_indices[0].tolist():
        yield from touch_cube(hand, key)
    yield from press_button(hand)


def touch_cube(hand: Hand, key: int) -> Actions:
    """Bunch, Seq and ChainOfColors: touch a cube from above, and rise again."""
    scene = hand.scene
    top = place_of(scene.cubes[key]) + _up(scene.CUBE_HALFSIZE + 0.005 + _ABOVE_CUBE)
    yield from hand.go(hand.position * [1, 1, 0] + _up(TRAVEL), 0.03, CLOSED)
    yield from hand.go(np.array([top[0], top[1], TRAVEL]), 0.02, CLOSED)
    for _ in range(30):
        if bool(scene.touched_cubes[0, key]):
            break
        yield hand.action(0.7 * (top - hand.position), gripper=CLOSED)
    yield from hand.go(hand.position * [1, 1, 0] + _up(TRAVEL), 0.03, CLOSED)


def press_button(hand: Hand) -> Actions:
    """Bunch, Seq and ChainOfColors: press the button, and rise as far as is required."""
    scene = hand.scene
    button = np.array([*scene.button_xy[0].tolist(), float(scene.button_top_z[0])])
    yield from hand.go(hand.position * [1, 1, 0] + _up(TRAVEL), 0.03, CLOSED)
    yield from hand.go(button * [1, 1, 0] + _up(TRAVEL), 0.02, CLOSED)
    for _ in range(30):
        if bool(scene.pending_press[0]):
            break
        yield hand.action((0, 0, -0.02), gripper=CLOSED)
    yield from hand.go(hand.position + _up(scene.REQUIRED_LIFT_HEIGHT + 0.03), 0.005, CLOSED)


def take_back(hand: Hand) -> Actions:
    """TakeItBack: carry the cube to the target, and back to where it was."""
    begin = place_of(hand.scene.initial_region)
    yield from carry_to_target(hand)
    yield from carry(hand, begin)


def carry_to_target(hand: Hand) -> Actions:
    """TakeItBack: take the cube to the target, until it counts as reached.

    The target is at the end of the arm's reach, so the hand leans outward on the way there.
    """
    scene = hand.scene
    goal = place_of(scene.goal_region)
    yield from grasp(hand, lambda: place_of(scene.cube))
    for _ in range(25):
        if bool(scene.goal_reached_status[0]):
            break
        action = hand.action(_level(goal - hand.position, _EDGE), gripper=CLOSED)
        action[4] = 1.0
        yield action


def carry(hand: Hand, place: np.ndarray) -> Actions:
    """TakeItBack: bring what the hand holds to a place [3]."""
    for _ in range(30):
        yield hand.action(_level(place - hand.position, REACH), gripper=CLOSED)


_EDGE = (
    0.06  # metres an action asks for at the end of the reach: what cannot be reached moves nothing
)


def _level(offset: np.ndarray, most: float) -> np.ndarray:
    """The level part of an offset [3], at most so long."""
    offset = offset * [1, 1, 0]
    length = float(np.linalg.norm(offset))
    return offset * min(1.0, most / max(length, 1e-9))


def grasp(hand: Hand, place: Any) -> Actions:
    """Go over a thing, down to it, and close the fingers.

    place: a function that gives its position [3].
    """
    yield from hand.go(lambda: place() + _up(0.08), 0.015, OPEN)
    yield from hand.go(place, 0.008, OPEN, steps=15)
    yield from hand.hold(3, CLOSED)


def push_round(hand: Hand) -> Actions:
    """RotateLenient: push the peg at one end until it lies as it should. It may move, and the hand
    pushes it round faster than it turns itself.
    """
    scene = hand.scene
    while True:
        way = float(np.sign(scene.angle_diff[0].item()))
        end = min((1, -1), key=lambda end: _farthest(scene, end, way))

        # Down to the side from which this end is pushed.
        beside = partial(_pushing_place, scene, end, way)
        if hand.position[2] < 0.08:
            yield from hand.go(hand.position * [1, 1, 0] + _up(0.1), 0.02, CLOSED)
        yield from hand.go(partial(beside, 0.07), 0.02, CLOSED)
        yield from hand.go(beside, 0.012, CLOSED, steps=8)

        # Push, and begin anew from the other side where it was too far.
        while (left := way * float(scene.angle_diff[0])) > -0.08:
            if left < 0.05:
                yield hand.action(gripper=CLOSED)
                continue
            along, across = _axes(_yaw_of(scene.peg), end, way)
            gap = place_of(scene.peg) - hand.position
            motion = across * np.clip(0.12 * left, 0.02, 0.05)
            motion += along * np.clip(along @ gap + _LEVER, -0.02, 0.02)
            motion[2] = gap[2]
            action = hand.action(motion, gripper=CLOSED)
            if _reach_of(hand.position) > _LEAN:
                action[4] = 1.0
            yield action


_LEVER = 0.085  # metres from the peg's middle to where it is pushed
_LEAN = 0.7  # metres from the robot's foot beyond which the hand has to lean outward
_FOOT = np.array([-0.615, 0.0])


def _axes(angle: float, end: int, way: float) -> tuple[np.ndarray, np.ndarray]:
    """Directions [3] from the middle of a peg to one of its ends, and that in which this end moves
    when the peg turns one way.
    """
    along = end * np.array([np.cos(angle), np.sin(angle), 0.0])
    across = way * np.array([-along[1], along[0], 0.0])
    return along, across


def _pushing_place(scene: Any, end: int, way: float, above: float = 0.0) -> np.ndarray:
    """Where the hand begins to push [3], or so many metres above it."""
    along, across = _axes(_yaw_of(scene.peg), end, way)
    return place_of(scene.peg) + _LEVER * along - 0.06 * across + _up(above)


def _farthest(scene: Any, end: int, way: float) -> float:
    """How far the hand gets from the robot's foot if it pushes this end all the way; metres."""
    begin = _yaw_of(scene.peg)
    turns = np.linspace(0, abs(float(scene.angle_diff[0])), 9)
    middle = place_of(scene.peg)
    farthest = 0.0
    for turn in turns:
        along, across = _axes(begin + way * turn, end, way)
        farthest = max(farthest, _reach_of(middle + _LEVER * along - 0.05 * across))
        middle = middle + 0.1 * turns[1] * across  # the peg is pushed away as well
    return farthest


def _reach_of(place: np.ndarray) -> float:
    """Level distance of a place [3] from the robot's foot; metres."""
    return float(np.linalg.norm(place[:2] - _FOOT))


def rotate(hand: Hand) -> Actions:
    """RotateStrict: take the peg in its middle and turn it.

    Fingers that close askew turn the peg until it lies between them, so the hand need not be right
    across it: of all ways to take it, the one with the least turning is chosen.
    """
    scene = hand.scene
    peg = scene.peg
    goal_angle = float(scene.target_angle[0])
    across = wrapped(_yaw_of(peg) + np.pi / 2 - hand.yaw)
    ways = []
    for half_turns in (-1, 0, 1):
        for askew in np.linspace(-_ASKEW, _ASKEW, 9):
            to_grasp = across + half_turns * np.pi + askew
            to_end = goal_angle - askew
            ways.append((abs(to_grasp) + abs(to_end), to_grasp))
    goal = hand.yaw + min(ways)[1]
    for _ in range(60):
        left = wrapped(goal - hand.yaw)
        offset = place_of(peg) + _up(0.07) - hand.position
        if abs(left) < 0.05 and np.linalg.norm(offset) < 0.015:
            break
        yield hand.action(offset, left)
    yield from hand.go(lambda: place_of(peg), 0.01, OPEN, steps=8)
    yield from hand.hold(3, CLOSED)
    place = hand.position
    while True:
        left = float(scene.angle_diff[0])
        yield hand.action(place - hand.position, 1.5 * left, CLOSED)


_ASKEW = 0.45  # radians that the fingers may be off when they close
_RATE = 0.038  # metres that the hand moves in a step at most
_LAG = 2.5  # steps by which the hand is behind what it is told


def catch(hand: Hand) -> Actions:
    """InterceptGrab: meet the ball from above, follow it at its speed, and close the fingers."""
    scene = hand.scene
    ball = scene.ball
    for _ in range(70):
        place = place_of(ball)
        step = ball.linear_velocity[0].cpu().numpy().astype(np.float64) * _STEP_SECONDS
        step[2] = 0
        # The earliest time at which the hand can be over the ball
        ahead = _LAG
        for wait in range(60):
            if np.linalg.norm((place + wait * step - hand.position)[:2]) <= _RATE * wait:
                ahead = max(ahead, float(wait))
                break
        offset = place + ahead * step - hand.position
        gap = place - hand.position
        if np.linalg.norm(gap[:2]) > 0.015:
            offset[2] = 0.065 - hand.position[2]
        yield hand.action(offset, gripper=OPEN)
        gap = place_of(ball) - hand.position
        if np.linalg.norm(gap[:2]) < 0.018 and abs(gap[2]) < 0.012:
            break
    step = ball.linear_velocity[0].cpu().numpy().astype(np.float64) * _STEP_SECONDS
    for number in range(4):
        yield hand.action(_LAG * step * (0.8, 0.8, 0.4, 0)[number] * [1, 1, 0], gripper=CLOSED)


def catch_and_carry(hand: Hand) -> Actions:
    """Intercept: catch the ball, and bring it to the target."""
    yield from catch(hand)
    target = place_of(hand.scene.goal_region)
    while True:
        yield hand.action(_level(target - hand.position, REACH), gripper=CLOSED)


def _up(height: float) -> np.ndarray:
    return np.array([0.0, 0.0, height])


def wrapped(angle: float) -> float:
    """The same angle in (−π, π]."""
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def _yaw_of(thing: Any) -> float:
    matrix = thing.pose.to_transformation_matrix()[0].cpu().numpy()
    return float(np.arctan2(matrix[1, 0], matrix[0, 0]))


_SCRIPTS: dict[str, Callable[[Hand], Actions]] = {
    "Remember": touch,
    "FindImposter": touch,
    "BunchOfColors": touch_several,
    "SeqOfColors": touch_several,
    "ChainOfColors": touch_several,
    "InterceptGrab": catch,
    "Intercept": catch_and_carry,
    "RotateLenient": push_round,
    "RotateStrict": rotate,
    "TakeItBack": take_back,
}
"""Beginning of the name of a task's class → its script; the longer ones first."""
