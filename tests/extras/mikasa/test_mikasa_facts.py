"""Facts of MIKASA-Robo-VLA's scenes, and twins in which one of them is flipped."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mme_vla.envs.base import environment
from mme_vla.envs.facts import FactLog
from mme_vla.extras.mikasa.catalog import FAMILY_OF
from mme_vla.extras.mikasa.facts import InOrder, Several, facts_of_task
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
    assert len(with_twin) == 45 and kinds == {"Object", "Negative", "Capacity", "Sequential"}
    assert not any(FAMILY_OF[task].needs for task in with_twin)
    source = environment("mikasa")
    assert source.twin(source.episode("RotateStrictPos", "test", 0)) is None


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
    shown = [[fact for fact in one if not fact.name.startswith("touch")] for one in facts]
    changed = [a.value != b.value for a, b in zip(*shown, strict=True)]
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
