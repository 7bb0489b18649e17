"""Facts of an episode: their intervals, what they agree with on the sixteen tasks, and the table
beside a recording.
"""

import csv
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import REPOSITORY
from helpers.tiers import slow_or_nightly
from mme_vla import Fact
from mme_vla.config.plugins import import_plugins
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes
from mme_vla.envs.facts import COLUMNS, FactLog, VisibleFact, read_facts, write_facts
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.errors import UserError
from mme_vla.extras.probing.evidence import EvidenceEpisode

RED = {"cover 0": VisibleFact("red: container_1", {"container_1"})}
SWAP = {"swap 1": VisibleFact("container_1 and container_2", {"container_1", "container_2"}, True)}
SLOW_TASKS = ("VideoUnmask", "ButtonUnmaskSwap", "StopCube")
"""One task a way of naming facts; the others are nightly."""


def evidence(facts: Sequence[Fact]) -> dict[str, list[int]]:
    """Name of each fact → the frames that show it."""
    none = np.zeros(0)
    episode = EvidenceEpisode("", 0, 0, 0, facts, boundaries=none, states=none, images={})
    return {name: frames.tolist() for name, frames in episode.evidence.items()}


def test_a_fact_is_shown_from_its_first_to_its_last_frame() -> None:
    log = FactLog()
    for frame_facts in (RED, RED, {}, RED | SWAP, SWAP):
        log.add(frame_facts)
    first, again, swap = log.facts
    assert (first.frames, again.frames, swap.frames) == ((0, 1), (3, 3), (3, 4))
    assert first.name == again.name and first.value == "red: container_1"
    assert evidence(log.facts) == {"cover 0": [0, 1, 3], "swap 1": [3, 4]}


def test_a_fact_changes_where_what_it_is_about_is_moved_or_counted_on() -> None:
    log = FactLog()
    other = {"cover 1": VisibleFact("blue: container_3", {"container_3"})}
    for frame_facts in (RED | other, {}, SWAP):
        log.add(frame_facts)
    assert [fact.changed for fact in log.facts] == [2, None, None]
    log = FactLog()
    for i in range(3):
        log.add({f"visit {i}": VisibleFact(str(i + 1), {"visits"}, replaces=True)})
    assert [fact.changed for fact in log.facts] == [1, 2, None], "only the first change counts"


def test_a_fact_is_needed_at_the_decisions_from_its_first_frame_on() -> None:
    log = FactLog()
    log.add({}, decides=True)
    log.add(RED)
    log.add({}, decides=True)
    log.add(SWAP, decides=True)
    assert [fact.needed for fact in log.facts] == [(2, 3), (3,)]


def test_facts_survive_plain_values_and_make_a_table(tmp_path: Path) -> None:
    facts = [Fact("cover 0", "red: a, blue: b", (0, 31), (114, 200), 64), Fact("b", "1", (3, 3))]
    assert read_facts([fact.to_dict() for fact in facts], "a.json") == facts
    write_facts(tmp_path / "meta" / "facts.csv", [(0, "VideoUnmask", facts), (1, "Other", [])])
    with (tmp_path / "meta" / "facts.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert tuple(header) == COLUMNS
    assert rows == [
        ["0", "VideoUnmask", "cover 0", "red: a, blue: b", "0", "31", "114 200", "64"],
        ["0", "VideoUnmask", "b", "1", "3", "3", "", ""],
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": [1]}, r"a.json: facts\[0\].frames=\[1\] must be a list of 2 values"),
        ({"value": 3}, r"a.json: facts\[0\].value=3 must be a text"),
        ({"shown": 3}, r"Unknown key a.json: facts\[0\].shown"),
    ],
)
def test_damaged_facts_are_refused(change: dict[str, object], message: str) -> None:
    values = Fact("b", "1", (3, 3)).to_dict()
    with pytest.raises(UserError, match=message):
        read_facts([values | change], "a.json")
    with pytest.raises(UserError, match=r"a.json: facts\[0\] lacks the key 'name'"):
        read_facts([{"value": "1"}], "a.json")


def test_an_environment_of_ones_own_names_its_facts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "blink")
    import_plugins(["blink"])
    values = set()
    for episode in range(8):
        env = environment("blink").open("Blink", "train", episode)
        observation, _ = env.reset()
        (fact,) = env.facts
        values.add(fact.value)
        images = observation["top_rgb_list"]
        assert fact.needed == (len(images) - 1,), "the first frame at which the arm can move"
        yellow = [bool((image == (255, 220, 0)).all(-1).any()) for image in images]
        first, last = fact.frames
        assert np.flatnonzero(yellow).tolist() == list(range(first, last + 1))
        columns = np.flatnonzero((images[0] == (255, 220, 0)).all(-1).any(0))
        assert (columns.mean() < 32) == (fact.value == "left")
    assert values == {"left", "right"}


# The facts of the sixteen tasks were once named by hand, task by task. These are those rules, read
# from the running script at each frame.


def _key_poses(letters: str = "abcdefgh") -> Callable[[Any, Mapping[int, Any]], set[str]]:
    def rule(task: Any, ended: Mapping[int, Any]) -> set[str]:
        has_video = any(subtask.video for subtask in task.progress.subtasks)
        names = set()
        for i, subtask in ended.items():
            is_choice = subtask.choice != "" and subtask.choice in letters
            if is_choice and subtask.video == has_video:
                names.add(f"{i} {subtask.text}")
        return names

    return rule


def _moving(kind: str, motions: Any) -> set[str]:
    return {f"{kind} {i}" for i, motion in enumerate(motions) if motion.active}


def _unmask(task: Any, ended: Mapping[int, Any]) -> set[str]:
    return _moving("cover", task.visible_motions)


def _unmask_swap(task: Any, ended: Mapping[int, Any]) -> set[str]:
    cover, *swaps = task.visible_motions
    names = _moving("cover", [cover])
    return names | {f"swap {i}" for i, swap in enumerate(swaps, 1) if swap.active}


def _video_place(task: Any, ended: Mapping[int, Any]) -> set[str]:
    return _key_poses("bc")(task, ended) | _moving("swap", task.swaps)


def _video_repick(task: Any, ended: Mapping[int, Any]) -> set[str]:
    names = _key_poses("a")(task, ended) | _moving("swap", task.swaps)
    for i, subtask in ended.items():
        if subtask.choice == "b" and not subtask.video:
            names.add(f"{i} {subtask.text}")
    return names


def _pick_highlight(task: Any, ended: Mapping[int, Any]) -> set[str]:
    return _moving("highlight", task.highlights)


def _stop_cube(task: Any, ended: Mapping[int, Any]) -> set[str]:
    if task.stopped_at is None and task._on_target():
        return {f"visit {task.steps_done // task.interval}"}
    return set()


FORMER: dict[str, Callable[[Any, Mapping[int, Any]], set[str]]] = {
    "VideoUnmask": _unmask,
    "ButtonUnmask": _unmask,
    "VideoUnmaskSwap": _unmask_swap,
    "ButtonUnmaskSwap": _unmask_swap,
    "PickHighlight": _pick_highlight,
    "VideoRepick": _video_repick,
    "VideoPlaceButton": _video_place,
    "VideoPlaceOrder": _video_place,
    "BinFill": _key_poses("b"),
    "PickXtimes": _key_poses("b"),
    "SwingXtimes": _key_poses("b"),
    "StopCube": _stop_cube,
    "MoveCube": _key_poses(),
    "InsertPeg": _key_poses(),
    "PatternLock": _key_poses(),
    "RouteStick": _key_poses(),
}
DIFFICULTIES = ("easy", "medium", "hard")


class Former:
    """What was named by hand in the frames of a demonstration, and the frames of decisions."""

    def __init__(self, task: str, env: Any) -> None:
        self.rule = FORMER[task]
        self.env = env
        self.named: dict[str, list[int]] = {}
        self.decisions: list[int] = []
        self.frames = 0
        self._ended: dict[int, int] = {}
        self._begun = -1

    def take(self, step: Any) -> None:
        progress = self.env.progress
        in_video = step.info["is_video_demo"]
        for i in range(len(self._ended), progress.index):
            self._ended[i] = self.frames
        recent = {}
        for i, at in self._ended.items():
            if self.frames - at < 16 and progress.subtasks[i].video <= in_video:
                recent[i] = progress.subtasks[i]
        for name in self.rule(self.env, recent):
            self.named.setdefault(name, []).append(self.frames)
        current = progress.current
        if not in_video and current is not None and progress.index > self._begun:
            self._begun = progress.index
            if current.operation:
                self.decisions.append(self.frames)
        self.frames += 1


@pytest.mark.parametrize("task", slow_or_nightly(TASK_NAMES, SLOW_TASKS.__contains__))
def test_facts_of_the_simulator_are_those_once_named_by_hand(task: str) -> None:
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: the extra `sim` has it"
    )
    from mme_vla.envs.make import make_task
    from mme_vla.envs.robomme.recording.recorder import Recorder

    specs = choose_episodes(task, None, "test")
    for difficulty in DIFFICULTIES:
        spec = next(spec for spec in specs if spec.difficulty == difficulty)
        env = make_task(task, render=False, **spec.options)
        former = Former(task, env)
        try:
            facts = Recorder(env, render=False, on_step=former.take).record().facts
        finally:
            env.close()
        assert facts, difficulty
        assert evidence(facts) == former.named, difficulty
        for fact in facts:
            assert fact.value
            needed = [frame for frame in former.decisions if frame >= fact.frames[0]]
            assert list(fact.needed) == needed, fact
            assert fact.changed is None or fact.frames[0] < fact.changed < former.frames
        if difficulty == "hard" and task.endswith("UnmaskSwap"):
            assert any(fact.changed is not None for fact in facts), "a swap moves a cube"


@pytest.mark.slow
def test_a_running_environment_names_the_facts_of_its_frames() -> None:
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: the extra `sim` has it"
    )
    env = environment("mme_vla").open("VideoUnmask", "test", 0, render=False)
    try:
        observation, _ = env.reset()
        (fact,) = environment("mme_vla").facts(env)
        frames = len(observation["joint_state_list"])
        (needed,) = fact.needed
        assert fact.name == "cover 0" and fact.frames == (0, 31)
        assert needed == frames - 1, "the first decision is at the current frame"
        env.reset()
        assert list(environment("mme_vla").facts(env)) == [fact], "a reset begins anew"
    finally:
        env.close()
