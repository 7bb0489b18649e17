"""What the tasks of MIKASA-Robo-VLA show and need later, from the simulator's state: one class for
each kind of scene, its facts, the fact that a twin flips, and what can be chosen.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from mme_vla.envs.facts import Candidates, VisibleFact
from mme_vla.extras.mikasa.demonstrators import (
    OPEN,
    TRAVEL,
    Actions,
    Hand,
    carry,
    carry_to_target,
    place_of,
    press_button,
    touch_cube,
    touch_thing,
    wrapped,
)

_COLORS = ("red", "lime", "blue")  # of shapes in colours, by their `color_id`
_NEAR = 0.1  # metres from the hand to a thing that it touches, or has just touched
_MOVED = 0.01  # metres, and radians: a thing that was moved by less lies as it lay
_COLUMN = 0.1  # metres between the three columns in which TakeItBack's cube begins
_COLUMNS = ("right", "middle", "left")
_LIGHTS = ("red", "green", "blue")  # of lamps and balls, by their number
_SHAPES = ("circle", "square", "triangle")  # that are traced, by their number
_CUPS = ("left", "center", "right")


def _in_view(thing: Any) -> bool:
    """Whether a thing is on the table: what a scene hides, it puts 1,000 metres up."""
    return bool(place_of(thing)[2] < 1)


class SceneFacts:
    """What the frames of a scene show. This one shows nothing that is needed later.

    Args:
        scene: has been reset; it is read at each frame.
        cue_end: the first step at which the answer can be given.
        by_choice: whether each decision is about a whole movement, wherever the hand is. The first
            one is made while nothing is shown, so that nothing but memory can tell scenes apart.
    """

    has_twin: ClassVar[bool] = False
    """Whether the answer can be flipped, and nothing else with it."""
    has_choices: ClassVar[bool] = False
    """Whether the answer is one of several things."""

    def __init__(self, scene: Any, cue_end: int, by_choice: bool = False) -> None:
        self._scene = scene
        self._cue_end = cue_end
        self._by_choice = by_choice
        self._first_decision = max(cue_end - 1, 0) if by_choice else cue_end

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        """What the next frame shows, and whether a decision begins there that depends on the facts.

        time: steps since the reset.
        """
        return {}, False

    def flip(self) -> None:
        """Change the fact of the twin, right after the reset, and nothing else."""

    def candidates(self, time: int) -> Candidates | None:
        """What the hand can go to, once the flipped fact decides which is right."""
        return None

    def things(self) -> Mapping[str, Any]:
        """What the answer is one of: an object in words → the simulator's actor."""
        return {}

    def choices(self) -> Mapping[str, Actions]:
        """What can be chosen, the same at every moment: text → the actions that do it."""
        return {}

    def correct_choice(self) -> int:
        """The number, among the choices, of the one that leads to success."""
        raise NotImplementedError


class Recall(SceneFacts):
    """Remember: one object is shown. FindImposter: all but one are shown, and that one is right.
    All are on the table when the answer can be given.
    """

    has_twin = True
    has_choices = True

    @property
    def _things(self) -> Mapping[int, Any]:
        """Key → object, in the order of the table's."""
        things: Mapping[int, Any] = getattr(self._scene, "cubes", None) or self._scene.shape_actors
        return things

    @property
    def _right(self) -> Any:
        """The tensor that holds the key, or keys, of what is right [1, …]."""
        for name in ("true_color_indices", "true_shape_indices", "imposter_key"):
            if hasattr(self._scene, name):
                return getattr(self._scene, name)
        raise AttributeError(f"{type(self._scene).__name__} names no right object")

    @property
    def _answers(self) -> list[int]:
        """Keys of what is right, in their order."""
        keys: list[int] = self._right[0].reshape(-1).tolist()
        return keys

    def _name(self, key: int) -> str:
        """What makes an object different from the others."""
        scene = self._scene
        if hasattr(scene, "shape_color_dict"):
            about = scene.shape_color_dict[key]
            return f"{_COLORS[about['color_id']]} {about['shape']}"
        if hasattr(scene, "shape_dict"):
            return str(scene.shape_dict[key])
        return str(scene.COLOR_MAPPING[key][0]).lower()

    def _described(self, key: int) -> str:
        """An object in words: its colour, its shape, or both."""
        if hasattr(self._scene, "shape_actors"):
            return self._name(key)
        return f"{self._name(key)} cube"

    def _shown(self, time: int) -> Sequence[int]:
        """Keys of the objects that are shown."""
        if time >= int(self._scene.cue_steps_per_env[0]):
            return ()
        if "Imposter" not in type(self._scene).__name__:
            return self._answers
        return [key for key in self._things if key not in self._answers]

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        visible = {}
        for number, key in enumerate(self._shown(time), 1):
            visible[f"object {number}"] = VisibleFact(self._name(key))
        return visible, time == self._first_decision

    def flip(self) -> None:
        """The next object is the right one."""
        scene = self._scene
        self._right[:] = (self._answers[0] + 1) % len(self._things)
        if hasattr(scene, "_apply_phase_layout"):
            scene._apply_phase_layout(scene.elapsed_steps.long())

    def candidates(self, time: int) -> Candidates | None:
        if time < self._first_decision:
            return None
        return self._among(list(self._things), self._answers[0], time)

    def things(self) -> Mapping[str, Any]:
        return {self._described(key): thing for key, thing in self._things.items()}

    def choices(self) -> Mapping[str, Actions]:
        hand = Hand(self._scene)
        choices = {}
        for key in self._things:
            touch = self._touch(hand, key)
            choices[f"touch the {self._described(key)}"] = self._after_cue(hand, touch)
        return choices

    def _touch(self, hand: Hand, key: int) -> Actions:
        """The actions that touch an object."""
        thing = self._things[key]
        return touch_thing(hand, lambda: place_of(thing) - hand.position)

    def correct_choice(self) -> int:
        return list(self._things).index(self._answers[0])

    def _after_cue(self, hand: Hand, script: Actions) -> Actions:
        """The actions of a script, once the objects are there."""
        while int(self._scene.elapsed_steps[0]) < self._cue_end:
            yield hand.action(gripper=OPEN)
        yield from script

    def _among(self, keys: Sequence[int], right: int, time: int) -> Candidates:
        """These objects, of which one is right."""
        scene = self._scene
        places = []
        for key in keys:
            place = place_of(self._things[key])
            if time < self._cue_end:
                # Where it will appear: x and y first
                poses = getattr(scene, "_manip_raw_poses", None) or scene.initial_poses
                place = poses[key][0].cpu().numpy()
            places.append(place[:2].tolist())
        return Candidates(places, [keys.index(right)])


class Several(Recall):
    """BunchOfColors and SeqOfColors: some cubes are shown together or one by one, and are to be
    touched in any order. The hand leaves no trace on a cube, so that touches are facts as well.

    Twins differ in the last cube. The decision is the last one to touch, made where the hand has
    been lifted: before, it moves to no cube.
    """

    _in_order: ClassVar[bool] = False

    def __init__(self, scene: Any, cue_end: int, by_choice: bool = False) -> None:
        super().__init__(scene, cue_end, by_choice)
        self._touched: list[int] = []

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        scene = self._scene
        shown = list(self._shown(time))
        duration = getattr(scene, "cue_step_duration_per_env", None)
        if shown and duration is not None:
            shown = [self._answers[time // int(duration[0])]]
        visible = {}
        for key in shown:
            number = self._answers.index(key) + 1
            visible[f"object {number}"] = VisibleFact(self._name(key))

        new = []
        for key in scene.touched_cubes[0].nonzero().reshape(-1).tolist():
            if key not in self._touched:
                new.append(key)
        self._touched += new
        if self._touched:
            last = self._touched[-1]
            gap = place_of(self._things[last]) - place_of(scene.agent.tcp)
            if new or np.linalg.norm(gap) < _NEAR:
                fact = VisibleFact(self._name(last), {"touches"}, replaces=self._in_order)
                visible[f"touch {len(self._touched)}"] = fact
        return visible, time == self._first_decision or bool(new)

    def _is_free(self, time: int) -> bool:
        """Whether the hand can go to any cube next, after the cue: of motions where it is at the
        height at which it passes over cubes.
        """
        if self._by_choice:
            return time >= self._first_decision
        height = float(place_of(self._scene.agent.tcp)[2])
        return time >= self._cue_end and abs(height - TRAVEL) < 0.03

    def flip(self) -> None:
        """A cube that was not among them stands for the last one."""
        others = [key for key in self._things if key not in self._answers]
        self._right[0, -1] = others[0]

    def candidates(self, time: int) -> Candidates | None:
        *former, last = self._answers
        if not self._is_free(time) or set(former) - set(self._touched):
            return None
        return self._among([key for key in self._things if key not in former], last, time)

    def choices(self) -> Mapping[str, Actions]:
        hand = Hand(self._scene)
        press = self._after_cue(hand, press_button(hand))
        return {**super().choices(), "press the button": press}

    def _touch(self, hand: Hand, key: int) -> Actions:
        return touch_cube(hand, key)

    def correct_choice(self) -> int:
        touched = self._scene.touched_cubes[0]
        for key in self._answers:
            if not bool(touched[key]):
                return list(self._things).index(key)
        return len(self._things)


class InOrder(Several):
    """ChainOfColors: the same, in the order in which they were shown. Each touch replaces the last
    one, as the place in the order. Twins exchange the first two.
    """

    _in_order = True

    def flip(self) -> None:
        self._right[0, :2] = self._right[0, :2].flip(0)

    def candidates(self, time: int) -> Candidates | None:
        return Recall.candidates(self, time) if self._is_free(time) else None


class Origin(SceneFacts):
    """TakeItBack: where the cube lay. It has no twin, since the hand's pose at the target differs
    with the column from which it came.
    """

    has_choices = True
    _is_reached = False

    def _column(self) -> int:
        """Of the three columns, 0 to 2, that in which the cube began."""
        return int(np.floor(place_of(self._scene.initial_region)[1] / _COLUMN + 0.25)) + 1

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        scene = self._scene
        gap = place_of(scene.cube) - place_of(scene.initial_region)
        reached = bool(scene.goal_reached_status[0])
        decides = reached and not self._is_reached
        self._is_reached = reached
        if np.linalg.norm(gap[:2]) < _MOVED:
            return {"origin": VisibleFact(_COLUMNS[self._column()])}, decides
        return {}, decides

    def things(self) -> Mapping[str, Any]:
        return {"cube": self._scene.cube}

    def choices(self) -> Mapping[str, Actions]:
        hand = Hand(self._scene)
        choices = {"carry the cube to the target": carry_to_target(hand)}
        begin = place_of(self._scene.initial_region)
        for number, name in enumerate(_COLUMNS):
            place = begin + np.array([0, (number - self._column()) * _COLUMN, 0])
            choices[f"bring the cube back to the {name}"] = carry(hand, place)
        return choices

    def correct_choice(self) -> int:
        if not bool(self._scene.goal_reached_status[0]):
            return 0
        return 1 + self._column()


class Turned(SceneFacts):
    """Rotate: how the peg lay, from which it is to be turned by an angle that the goal names."""

    _is_turned = False

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        scene = self._scene
        turned = abs(wrapped(float(scene.target_angle[0]) - float(scene.angle_diff[0]))) > _MOVED
        decides = turned and not self._is_turned
        self._is_turned |= turned
        if self._is_turned:
            return {}, decides
        degrees = np.rad2deg(float(scene.initial_rotations[0])) % 180
        return {"angle": VisibleFact(f"{degrees:.0f} degrees")}, decides


class Rolling(SceneFacts):
    """Intercept: the ball's velocity, which two frames show. It stays in view, so that no decision
    depends on a fact that is gone.
    """

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        ball = self._scene.ball
        if np.linalg.norm(place_of(ball) - place_of(self._scene.agent.tcp)) < _NEAR:
            return {}, False
        speed = float(np.linalg.norm(self._scene.oracle_info[0].cpu().numpy()))
        return {"velocity": VisibleFact(f"{speed:.2f} m/s")}, False


class Covered(SceneFacts):
    """ShellGame: which cup each ball is under, and each swap of two cups. A swap replaces what was
    known of its cups.

    In twins another cup hides the ball. Of cups that are shuffled, the last swap is another one.
    """

    has_twin = True
    _is_decided = False

    def __init__(self, scene: Any, cue_end: int, by_choice: bool = False) -> None:
        super().__init__(scene, cue_end, by_choice)
        self._cups = (scene.mug_left, scene.mug_center, scene.mug_right)
        if hasattr(scene, "red_ball"):
            self._right = scene.cup_with_ball_number
        else:
            self._right = scene.target_color

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        scene = self._scene
        if hasattr(scene, "red_ball"):
            balls = {"ball": (int(self._right[0]), scene.red_ball)}
        else:
            actors = (scene.ball_red, scene.ball_green, scene.ball_blue)
            balls = {f"{_LIGHTS[i]} ball": (i, ball) for i, ball in enumerate(actors)}
        visible = {}
        for name, (number, ball) in balls.items():
            # Cups fall while they are hidden, so that they can begin too deep to cover a ball.
            cup = self._cups[number]
            top = place_of(cup)[2] + float(scene.object_zs[number])
            is_covered = _in_view(cup) and top > 2 * scene.BALL_RADIUS
            if _in_view(ball) and not is_covered:
                visible[name] = VisibleFact(f"{_CUPS[number]} cup", {_CUPS[number]})
        decides = time >= self._cue_end and not visible and not self._is_decided
        self._is_decided |= decides
        since = time - int(scene.cue_steps_per_env[0])
        if hasattr(scene, "swap_pairs") and since >= 0:
            swap, phase = divmod(since, int(scene.steps_per_swap_per_env[0]))
            if phase and swap < int(scene.num_swaps_per_env[0]):
                pair = scene.swap_pairs[0, swap].tolist()
                before = scene.slot_of_mug[0, swap].tolist()
                value = " and ".join(_CUPS[place] for place in pair)
                cups = {_CUPS[cup] for cup in range(3) if before[cup] in pair}
                visible[f"swap {swap + 1}"] = VisibleFact(value, cups, replaces=True)
        return visible, decides

    def flip(self) -> None:
        scene = self._scene
        right = int(self._right[0])
        if hasattr(scene, "swap_pairs"):
            last = int(scene.num_swaps_per_env[0]) - 1
            before = scene.slot_of_mug[0, last].clone()
            pair = scene.swap_pairs[0, last]
            place = int(before[right])
            for other in range(3):
                if other != place and {place, other} != set(pair.tolist()):
                    new = (place, other)
            pair[0], pair[1] = min(new), max(new)
            after = before.clone()
            after[before == new[0]] = new[1]
            after[before == new[1]] = new[0]
            scene.slot_of_mug[0, last + 1 :] = after
            scene.oracle_info[:] = after[right]
        else:
            self._right[:] = (right + 1) % 3
            distance = (int(self._right[0]) - right) * scene.MIN_DIST
            for name in ("red_ball", "goal_site"):
                if hasattr(scene, name):
                    thing = getattr(scene, name)
                    pose = thing.pose.raw_pose.clone()
                    pose[:, 1] += distance
                    thing.pose = pose

    def candidates(self, time: int) -> Candidates | None:
        if not self._is_decided:
            return None
        places = [place_of(cup)[:2].tolist() for cup in self._cups]
        right = places[int(self._right[0])]
        places.sort(key=lambda place: place[1])  # an order that tells nothing about swaps
        return Candidates(places, [places.index(right)])


class Ordered(Covered):
    """ShellGameColorLampTouch: its balls always lie in the same order, so that it has no twin."""

    has_twin = False


class Blinks(SceneFacts):
    """BlinkCount: each blink, and each press of the button, which leave no trace. They are counts,
    and a higher one replaces the last.
    """

    _presses = 0

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        scene = self._scene
        visible = {}
        if _in_view(scene.lamp_bulb_on):
            starts = scene.blink_start_steps[0, : int(scene.target_blinks[0])]
            blinks = int((starts <= time).sum())
            visible[f"blink {blinks}"] = VisibleFact(str(blinks), {"blinks"}, replaces=True)
        if bool(scene.pending_press[0]):
            begun = int(scene.raw_press_count[0])
            visible[f"press {begun}"] = VisibleFact(str(begun), {"presses"}, replaces=True)
        presses = int(scene.press_count[0])
        decides = time == self._cue_end or presses > self._presses
        self._presses = presses
        return visible, decides


class Traced(SceneFacts):
    """TraceShape: each shape that the red cube traces. TraceShapeSeq: each that the green cube has
    traced as well. It leaves no trace, and replaces the last one as the place in the order.
    """

    _traces = 0

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        scene = self._scene
        paths = scene.waypoints[0].reshape(-1, scene.NUM_WAYPOINTS, 2)
        is_sequence = hasattr(scene, "shape_sequence")
        shapes = scene.shape_sequence[0] if is_sequence else scene.shape_type
        values = []
        for shape, path in zip(shapes.tolist(), paths.cpu().numpy(), strict=True):
            radius = np.linalg.norm(path[0] - path.mean(axis=0))
            values.append(f"{_SHAPES[shape]} of {radius:.2f} m")

        visible = {}
        since = time - int(scene.pre_demo_steps_per_env[0])
        if since >= 0 and time < self._cue_end:
            number = since // (scene.NUM_WAYPOINTS * scene.STEPS_PER_WAYPOINT)
            visible[f"shape {number + 1}"] = VisibleFact(values[number])
        decides = time == self._cue_end
        if is_sequence:
            traces = int(scene.shape_closed[0].sum())
            decides |= traces > self._traces
            self._traces = traces
            is_active = traces < int(scene.sequence_len[0])
            if is_active and bool(scene.checkpoint_visited[0, traces].any()):
                fact = VisibleFact(values[traces], {"traces"}, replaces=True)
                visible[f"trace {traces + 1}"] = fact
        return visible, decides


class Timed(SceneFacts):
    """TimedTransfer: when the lamp turned green. The cube is to be put down some steps later, which
    the goal names.
    """

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        visible = {}
        if time == int(self._scene.signal_step[0]):
            visible["signal"] = VisibleFact(f"step {time}")
        return visible, time == int(self._scene.window_start[0])


class Flashed(SceneFacts):
    """GatherAndRecall: the colour in which the lamp flashes, needed once every cube has been on the
    disc.
    """

    _is_gathered = False

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        visible = {}
        for color, bulb in zip(_LIGHTS, self._scene.lamp_bulbs_on, strict=True):
            if _in_view(bulb):
                visible["flash"] = VisibleFact(color)
        gathered = bool(self._scene.cubes_on_disc[0].all())
        decides = gathered and not self._is_gathered
        self._is_gathered = gathered
        return visible, decides


class Checked(SceneFacts):
    """BatteriesChecker: each battery that was in the socket, and whether the lamp was lit. All look
    the same when they are back, and the next one is chosen after each press of the button.
    """

    def visible_facts(self, time: int) -> tuple[Mapping[str, VisibleFact], bool]:
        scene = self._scene
        battery = int(scene.active_battery_idx[0])
        is_visible = bool(scene.new_insert_event[0]) or _in_view(scene.lamp_bulb_on)
        is_visible |= int(scene.action_stage[0]) == scene.STAGE_RETURN
        visible = {}
        if battery >= 0 and is_visible:
            result = "works" if bool(scene.working_mask[0, battery]) else "does not work"
            number = int(scene.checked_count[0]) + 1
            visible[f"check {number}"] = VisibleFact(f"battery {battery + 1} {result}")
        return visible, bool(scene.new_confirm_event[0])


_KINDS: Mapping[str, type[SceneFacts]] = {
    "Remember": Recall,
    "FindImposter": Recall,
    "BunchOfColors": Several,
    "SeqOfColors": Several,
    "ChainOfColors": InOrder,
    "TakeItBack": Origin,
    "Rotate": Turned,
    "Intercept": Rolling,
    "ShellGameColorLamp": Ordered,
    "ShellGame": Covered,
    "BlinkCount": Blinks,
    "TraceShape": Traced,
    "TimedTransfer": Timed,
    "GatherAndRecall": Flashed,
    "BatteriesChecker": Checked,
}
"""Beginning of a task's name → what its scenes show; the longer ones first."""


def facts_of_task(task: str) -> type[SceneFacts]:
    """The class that knows what the scenes of a task show."""
    for beginning, kind in _KINDS.items():
        if task.startswith(beginning):
            return kind
    return SceneFacts
