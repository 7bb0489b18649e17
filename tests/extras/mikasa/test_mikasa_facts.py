"""Facts of MIKASA-Robo-VLA's scenes, and twins in which one of them is flipped."""

from collections.abc import Iterable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mme_vla.envs.base import environment
from mme_vla.envs.facts import FactLog
from mme_vla.extras.mikasa.catalog import FAMILY_OF
from mme_vla.extras.mikasa.demonstrators import CLOSED, Hand, place_of
from mme_vla.extras.mikasa.facts import InOrder, SceneFacts, Several, facts_of_task
from mme_vla.extras.probing.evidence import record_evidence
from mme_vla.extras.probing.writing import operations_of


def thing(x: float, y: float, z: float = 0.02) -> SimpleNamespace:
    return SimpleNamespace(pose=SimpleNamespace(p=torch.tensor([[x, y, z]])))


def cubes_scene(right: list[int], one_by_one: bool) -> SimpleNamespace:
    """Five cubes in a row, of which some are shown in two steps for each; the hand is far away."""
    scene = SimpleNamespace(
        cubes={key: thing(0.1 * key, 0) for key in range(5)},
        true_color_indices=torch.tensor([right], dtype=torch.uint8),
        touched_cubes=torch.zeros((1, 5), dtype=torch.bool),
        cue_steps_per_env=torch.tensor([2 * len(right)]),
        COLOR_MAPPING={key: (f"Colour{key}", None) for key in range(5)},
        agent=SimpleNamespace(tcp=thing(1, 1, 0.16)),
    )
    if one_by_one:
        scene.cue_step_duration_per_env = torch.tensor([2])
    return scene


def played(known: Several, scene: Any, touches: dict[int, int], steps: int = 30) -> FactLog:
    """The facts of an episode in which cubes are touched at some steps, for two frames each."""
    log = FactLog()
    for time in range(steps):
        scene.agent.tcp = thing(1, 1, 0.16)
        for begun, key in touches.items():
            if begun <= time < begun + 2:
                scene.agent.tcp = scene.cubes[key]
                scene.touched_cubes[0, key] = True
        log.add(*known.visible_facts(time))
    return log


def test_cubes_shown_one_by_one_and_the_touches_are_facts() -> None:
    scene = cubes_scene([3, 0, 4], one_by_one=True)
    known = InOrder(scene, cue_end=8)
    facts = played(known, scene, {12: 3, 20: 0}).facts
    assert [(fact.name, fact.value, fact.frames) for fact in facts] == [
        ("object 1", "colour3", (0, 1)), ("object 2", "colour0", (2, 3)),
        ("object 3", "colour4", (4, 5)), ("touch 1", "colour3", (12, 13)),
        ("touch 2", "colour0", (20, 21)),
    ]  # fmt: skip
    assert facts[0].needed == (8, 12, 20) and facts[4].needed == (20,)
    assert [fact.changed for fact in facts] == [None, None, None, 20, None]


def test_touches_in_any_order_replace_none_and_a_bunch_is_shown_at_once() -> None:
    scene = cubes_scene([3, 0, 4], one_by_one=False)
    facts = played(Several(scene, cue_end=8), scene, {12: 0, 20: 3}).facts
    assert [fact.frames for fact in facts[:3]] == [(0, 5)] * 3
    assert all(fact.changed is None for fact in facts)


def test_storage_and_update_follow_from_facts_of_a_chain() -> None:
    scene = cubes_scene([3, 0], one_by_one=True)
    facts = played(InOrder(scene, cue_end=8), scene, {12: 3, 20: 0}).facts
    newest = operations_of(lambda step: np.array([0, step]), facts)
    assert newest.stored == [True, False, True, False, True, True, False, False, True]
    assert newest.updated == [True], "the newest touch is kept and the one before is not"


def test_twins_of_several_cubes_decide_at_the_last_one() -> None:
    scene = cubes_scene([3, 0, 4], one_by_one=False)
    known = Several(scene, cue_end=8)
    played(known, scene, {12: 3}, steps=18)
    assert known.candidates(8) is None and known.candidates(18) is None
    played(known, scene, {2: 0}, steps=6)
    candidates = known.candidates(24)
    assert candidates is not None
    assert np.allclose(np.array(candidates.places)[:, 0], [0.1, 0.2, 0.4])
    assert list(candidates.correct) == [2]
    known.flip()
    assert scene.true_color_indices.tolist() == [[3, 0, 1]]
    assert list(known.candidates(24).correct) == [0]
    scene.agent.tcp = thing(1, 1, 0.05)
    assert known.candidates(24) is None, "the hand has yet to rise"


def test_twins_of_a_chain_exchange_the_first_two_and_decide_at_once() -> None:
    scene = cubes_scene([3, 0, 4], one_by_one=True)
    known = InOrder(scene, cue_end=8)
    assert known.candidates(7) is None and list(known.candidates(8).correct) == [3]
    known.flip()
    assert scene.true_color_indices.tolist() == [[0, 3, 4]]
    assert list(known.candidates(8).correct) == [0]


def test_tasks_whose_answer_is_an_object_have_twins() -> None:
    with_twin = [task for task in FAMILY_OF if facts_of_task(task).has_twin]
    kinds = {FAMILY_OF[task].memory for task in with_twin}
    of_cups = {"Spatial", "Tracking"}
    assert kinds == {"Object", "Negative", "Capacity", "Sequential"} | of_cups
    assert len([task for task in with_twin if FAMILY_OF[task].memory not in of_cups]) == 45
    assert [task for task in with_twin if FAMILY_OF[task].memory in of_cups] == [
        "ShellGameTouch", "ShellGamePush", "ShellGameShuffleTouch", "ShellGameShuffleTouch-Long",
        "ShellGameShuffleColorLampTouch", "ShellGameShuffleColorLampTouch-Long",
    ]  # fmt: skip
    source = environment("mikasa")
    assert source.twin(source.episode("RotateStrictPos", "test", 0)) is None


def test_every_task_has_facts() -> None:
    assert not [task for task in FAMILY_OF if facts_of_task(task) is SceneFacts]


# In the simulator ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("simulator")
@pytest.mark.parametrize(
    "task",
    ["RememberColor3", "RememberShape5", "RememberShapeAndColor3x2", "FindImposterColor3",
     "FindImposterShape3", "FindImposterShapeAndColor3x2", "BunchOfColors3", "SeqOfColors3",
     "ChainOfColors3"],
)  # fmt: skip
def test_a_twin_differs_in_one_fact_and_the_script_solves_it(task: str) -> None:
    source = environment("mikasa")
    rows = [None, source.twin(source.episode(task, "test", 1))]
    facts, states, candidates = [], [], []
    for row in rows:
        env = source.open(task, "test", 1, render=False, row=row)
        reached = None
        frames = []
        for frame, _, _ in env.demonstration():
            frames.append(frame["state"])
            reached = reached or env.candidates
        assert env.success and reached is not None
        facts.append(env.facts)
        states.append(frames)
        candidates.append(reached)
        env.close()
    np.testing.assert_array_equal(states[0][0], states[1][0], "the robot begins elsewhere")
    visible = [[fact for fact in one if not fact.name.startswith("touch")] for one in facts]
    changed = [a.value != b.value for a, b in zip(*visible, strict=True)]
    assert sum(changed) == (2 if task.startswith("Chain") else 1)
    assert all(fact.needed for one in facts for fact in one)
    np.testing.assert_allclose(candidates[0].places, candidates[1].places, atol=0.01)
    assert not set(candidates[0].correct) & set(candidates[1].correct)


@pytest.mark.slow
@pytest.mark.usefixtures("simulator")
def test_what_a_rotation_begins_from_is_needed_once_the_peg_turns() -> None:
    episode = record_evidence(
        environment("mikasa").episode("RotateStrictPos", "test", 1), env="mikasa"
    )
    assert episode is not None and episode.states.shape == (episode.length, 7)
    (fact,) = episode.facts
    assert fact.frames[0] == 0 and fact.needed == (fact.frames[1] + 1,)
    assert fact.needed[0] < episode.length and fact.value.endswith("degrees")


# In the simulator, with models that stand in for lamps and cups -----------------------------------

HOLD = np.array([0, 0, 0, 0, 0, 0, 1], np.float32)


class Watched:
    """An episode that is played by the test, and what the simulator shows at each of its steps."""

    def __init__(self, task: str, episode: int = 0) -> None:
        self.env = environment("mikasa").open(task, "test", episode, render=False)
        self.env.reset()
        self.scene = self.env.env.scene
        self.places: dict[str, list[np.ndarray]] = {}
        self.report: dict[str, Any] = {}
        self._things = {}
        for name in _WATCHED:
            things = getattr(self.scene, name, [])
            if not isinstance(things, list):
                things = [things]
            self._things.update({f"{name} {i}": thing for i, thing in enumerate(things)})
        self._watch()

    def _watch(self) -> None:
        for name, actor in self._things.items():
            self.places.setdefault(name, []).append(place_of(actor))

    def play(self, actions: Iterable[np.ndarray]) -> None:
        """Perform actions, each of which is asked for after the one before."""
        for action in actions:
            *_, self.report = self.env.step(action)
            self._watch()

    def hold(self, steps: int) -> None:
        self.play([HOLD] * steps)

    def press(self, button: Any) -> None:
        """Press a button with the hand, and lift it again."""
        hand = Hand(self.scene)
        above = np.add(place_of(button), [0, 0, 0.2])
        self.play(hand.go(above, 0.01, CLOSED))
        self.play(hand.go(np.add(place_of(button), [0, 0, 0.02]), 0.01, CLOSED, steps=12))
        self.play(hand.go(above, 0.01, CLOSED))

    def put(self, thing: Any, place: Any) -> None:
        """Move a thing to a place [3], where it lies still from the next step on."""
        pose = thing.pose.raw_pose.clone()
        pose[0, :3] = torch.as_tensor(np.asarray(place), dtype=pose.dtype)
        thing.pose = pose
        thing.set_linear_velocity(torch.zeros(1, 3))

    def spans(self, name: str) -> list[tuple[int, int]]:
        """First and last frame of each time in which a thing was in view."""
        return runs([place[2] < 1 for place in self.places[name]])

    def frames(self, name: str) -> list[tuple[int, int]]:
        """First and last frame of each fact whose name begins so."""
        return [fact.frames for fact in self.env.facts if fact.name.startswith(name)]


_WATCHED = ("lamp_bulb_on", "lamp_bulbs_on", "red_cube", "mug_left", "mug_center", "mug_right",
            "red_ball", "ball_red", "ball_green", "ball_blue")  # fmt: skip


def runs(holds: Sequence[bool]) -> list[tuple[int, int]]:
    """First and last index of each run of true values."""
    edges = np.diff(np.concatenate([[0], np.asarray(holds, int), [0]]))
    begins, ends = np.nonzero(edges == 1)[0], np.nonzero(edges == -1)[0]
    return list(zip(begins.tolist(), (ends - 1).tolist(), strict=True))


@pytest.mark.slow
@pytest.mark.usefixtures("lamp_model", "cup_model")
@pytest.mark.parametrize("episode", range(3))
@pytest.mark.parametrize(
    "task",
    ["ShellGameTouch", "ShellGamePush", "ShellGameColorLampTouch", "ShellGameShuffleTouch",
     "ShellGameShuffleColorLampTouch"],
)  # fmt: skip
def test_a_ball_is_a_fact_until_a_cup_is_over_it_and_so_is_each_swap(
    task: str, episode: int
) -> None:
    watched = Watched(task, episode)
    watched.hold(watched.env.env.cue_end + 3)
    cups = np.stack([watched.places[f"mug_{name} 0"] for name in ("left", "center", "right")])
    first_covered = 0
    for color in ("red", "green", "blue"):
        name = f"ball_{color} 0" if "Color" in task else "red_ball 0"
        if name not in watched.places:
            continue
        ball = np.stack(watched.places[name])
        gaps = np.linalg.norm(cups[:, :, :2] - ball[None, :, :2], axis=2)
        over = cups[:, :, 2] + 1.3 * 0.04 > ball[None, :, 2] + 0.02
        is_covered = (gaps < 0.03) & over & (cups[:, :, 2] < 1)
        visible = runs((ball[:, 2] < 1) & ~is_covered.any(axis=0))
        facts = [fact for fact in watched.env.facts if fact.name in ("ball", f"{color} ball")]
        assert [fact.frames for fact in facts] == visible and len(visible) == 1
        side = ("left", "center", "right")[int(gaps[:, 0].argmin())]
        assert facts[0].value == f"{side} cup"
        first_covered = max(first_covered, visible[0][1] + 1)
    decision = max(first_covered, watched.env.env.cue_end)
    assert all(fact.needed == (decision,) for fact in watched.env.facts)

    # A swap is seen while cups are between their places.
    places = cups[:, 0, :2]
    gaps = np.linalg.norm(cups[:, :, None, :2] - places, axis=3)
    away = gaps.min(axis=2) > 1e-6
    moving = away.any(axis=0) & (cups[:, :, 2] < 1).all(axis=0) & ("Shuffle" in task)
    assert watched.frames("swap") == runs(moving)
    assert bool(moving.any()) == ("Shuffle" in task)
    for fact in watched.env.facts:
        if fact.name.startswith("swap"):
            middle = sum(fact.frames) // 2
            staying = gaps[~away[:, middle], middle].argmin(axis=1)
            exchanged = np.delete(["left", "center", "right"], staying)
            assert fact.value == " and ".join(exchanged)


@pytest.mark.slow
@pytest.mark.usefixtures("lamp_model")
def test_blinks_and_presses_are_counts() -> None:
    watched = Watched("BlinkCountButtonPressEasy", 0)
    scene = watched.scene
    watched.hold(watched.env.env.cue_end)
    lit = watched.spans("lamp_bulb_on 0")
    assert len(lit) == int(scene.target_blinks[0]) == 3
    assert watched.frames("blink") == lit
    counted = []
    for number in (1, 2):
        watched.press(scene.button_cap)
        assert int(scene.press_count[0]) == number
        counted.append(watched.env.facts[-1].frames[1] + 1)
    values = [(fact.name, fact.value) for fact in watched.env.facts]
    assert values == [("blink 1", "1"), ("blink 2", "2"), ("blink 3", "3"), ("press 1", "1"),
                      ("press 2", "2")]  # fmt: skip
    assert watched.env.facts[0].needed == (watched.env.env.cue_end, *counted)
    assert watched.env.facts[0].changed == lit[1][0] and watched.env.facts[2].changed is None
    assert watched.env.facts[3].changed == watched.env.facts[4].frames[0]


def shape_of(path: np.ndarray) -> str:
    """The name and size of a closed path [n, 2], by its area."""
    x, y = (path - path.mean(axis=0)).T
    radius = np.hypot(x, y).max()
    area = abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2 / radius**2
    areas = {"circle": np.pi, "square": 2, "triangle": 3 * 3**0.5 / 4}
    name = min(areas, key=lambda name: abs(areas[name] - area))
    return f"{name} of {radius:.2f} m"


@pytest.mark.slow
@pytest.mark.usefixtures("lamp_model")
@pytest.mark.parametrize("episode", range(3))
def test_what_the_red_cube_traced_is_needed_when_it_is_gone(episode: int) -> None:
    watched = Watched("TraceShapeHard", episode)
    watched.hold(watched.env.env.cue_end + 2)
    (fact,) = watched.env.facts
    path = np.stack(watched.places["red_cube 0"])
    first, last = fact.frames
    assert watched.spans("red_cube 0") == [(0, last)]
    assert np.allclose(path[:first, :2], path[first, :2])
    assert (np.diff(path[first : last + 1, :2], axis=0) != 0).any(axis=1).all()
    assert fact.value == shape_of(path[first : last + 1, :2])
    assert fact.needed == (last + 1,)


@pytest.mark.slow
@pytest.mark.usefixtures("lamp_model")
def test_shapes_of_a_sequence_and_what_was_traced_of_them_are_facts() -> None:
    watched = Watched("TraceShapeSeqHard", 0)
    begin = watched.env.env.cue_end
    watched.hold(begin)
    shapes = watched.env.facts
    paths = []
    for fact in shapes:
        first, last = fact.frames
        paths.append(np.stack(watched.places["red_cube 0"][first : last + 1]))
        assert fact.value == shape_of(paths[-1][:, :2])
    assert [fact.name for fact in shapes] == ["shape 1", "shape 2"]
    assert shapes[0].frames[1] + 1 == shapes[1].frames[0] and shapes[1].frames[1] == begin - 1
    for place in [*paths[0], paths[0][0]]:
        watched.put(watched.scene.green_cube, place)
        watched.hold(1)
    assert bool(watched.scene.shape_closed[0, 0]) and not bool(watched.scene.shape_closed[0, 1])
    closed = watched.frames("trace 1")[0][1] + 1
    assert watched.env.facts[2].value == shapes[0].value
    assert watched.env.facts[0].needed == (begin, closed) and closed <= begin + len(paths[0]) + 1


@pytest.mark.slow
@pytest.mark.usefixtures("lamp_model")
def test_the_signal_is_needed_at_the_first_step_at_which_the_cube_counts() -> None:
    reports = []
    needed = []
    for early in (0, 1):
        watched = Watched("TimedTransferEasy", 0)
        watched.hold(5)
        (lit,) = watched.spans("lamp_bulb_on 0")
        count = int(0.95 * 100)  # steps of the goal, less 5 %
        watched.hold(lit[0] + count - early - 1 - watched.env.env.time)
        place = np.add(place_of(watched.scene.red_disc), [0, 0, 0.023])
        watched.put(watched.scene.blue_cube, place)
        watched.hold(1)
        reports.append(watched.report["status"])
        (fact,) = watched.env.facts
        assert fact.frames == (lit[0], lit[0]) and fact.value == f"step {lit[0]}"
        needed.append(fact.needed)
        watched.env.close()
    assert reports == ["success", "fail"]
    assert needed == [(lit[0] + count,), ()]


@pytest.mark.slow
@pytest.mark.usefixtures("lamp_model")
def test_the_colour_of_a_flash_is_needed_once_all_cubes_are_gathered() -> None:
    watched = Watched("GatherAndRecall3", 0)
    scene = watched.scene
    for number, cube in enumerate(scene.cubes):
        watched.put(cube, np.add(place_of(scene.disc), [0.06 * number - 0.06, 0, 0.025]))
        watched.hold(20)
    lit = {
        name: watched.spans(f"lamp_bulbs_on {i}") for i, name in enumerate(("red", "green", "blue"))
    }
    (fact,) = watched.env.facts
    assert [fact.frames] == lit[fact.value] and sum(map(len, lit.values())) == 1
    (needed,) = fact.needed
    assert fact.frames[1] < needed and 40 < needed <= 45, "the third cube comes to lie still"


@pytest.mark.slow
@pytest.mark.usefixtures("lamp_model")
@pytest.mark.parametrize("task", ["BatteriesCheckerEasy-3", "BatteriesCheckerHard-3"])
def test_a_battery_in_the_socket_is_needed_after_each_press(task: str) -> None:
    watched = Watched(task, 0)
    scene = watched.scene
    confirmed = []
    lit = []
    (working,) = scene.working_mask[0].nonzero().reshape(-1).tolist()
    for check, number in enumerate((working, (working + 1) % 3), 1):
        begin = watched.env.env.time + 1
        battery = scene.batteries[number]
        watched.put(battery, scene.socket_slot_pos[0].numpy())
        watched.hold(3)
        if "Hard" in task:
            watched.put(battery, scene.tray_slot_positions[0, number].numpy())
        watched.hold(10)
        lit.append(any(place[2] < 1 for place in watched.places["lamp_bulb_on 0"][begin:]))
        fact = watched.env.facts[-1]
        result = "works" if lit[-1] else "does not work"
        assert (fact.name, fact.value) == (f"check {check}", f"battery {number + 1} {result}")
        assert fact.frames[0] == begin and fact.frames[1] < begin + 12
        watched.press(scene.button_cap)
        confirmed.append(watched.env.facts[-1].needed[-1])
        assert begin + 12 < confirmed[-1] <= watched.env.env.time
    assert lit == [True, False]
    checks = watched.env.facts
    assert len(checks) == 2 and checks[0].needed == tuple(confirmed)
    assert int(scene.checked_count[0]) == 2
