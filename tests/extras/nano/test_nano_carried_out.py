"""Demonstrations carried out motion by motion show what a policy meets; and noise that hides last
digits.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from mme_vla.embodiment.robomme import benchmark_state
from mme_vla.envs import metadata
from mme_vla.envs.make import make_env
from mme_vla.extras.nano import evaluating
from mme_vla.extras.nano.demonstrations import record
from mme_vla.extras.nano.evaluating import replay

SCENE = {"seed": 3_000_001, "difficulty": "easy"}


def test_its_decisions_stand_where_a_policy_that_decides_alike_would_stand(renderer: str) -> None:
    made = record("SwingXtimes", choices=[], cameras=[], carried_out=True, **SCENE)  # type: ignore[arg-type]
    assert made is not None
    env = make_env("SwingXtimes", action_space="waypoint", render=False, **SCENE)  # type: ignore[arg-type]
    observation, _ = env.reset()
    for number, (frame, target) in enumerate(
        zip(made.motions.decisions, made.motions.targets, strict=True)
    ):
        now = benchmark_state(
            observation["joint_state_list"][-1], observation["gripper_state_list"][-1]
        )
        assert np.allclose(made.states[frame], now, atol=1e-3), number
        observation, _, ended, _, info = env.step(target)
    facts = made.facts
    assert facts is not None
    assert [fact.value for fact in facts] == [str(i + 1) for i in range(len(facts))]
    assert [fact.name for fact in env.facts] == [fact.name for fact in facts]
    assert all(fact.needed and fact.frames[1] < made.length for fact in facts)
    env.close()
    assert ended and info["status"] == "success"


def test_what_the_demonstrator_does_solves_an_episode_through_the_actions_of_policies() -> None:
    pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")
    spec = metadata.episode("VideoUnmask", "val", 0)
    record = replay(spec, max_steps=500)
    assert (record.model, record.outcome, record.seed) == ("planner", "success", spec.seed)
    assert replay(spec, max_steps=record.steps // 2).outcome == "timeout"


class Refusing:
    """An environment in which no motion can be carried out."""

    scene_digest, steps_counted = "not built", 3

    def reset(self) -> None:
        pass

    def step(self, target: object) -> tuple:
        info = {
            "status": "error",
            "error_message": "no path to the pose",
            "exception_type": "PlanningError",
        }
        return {}, 0.0, True, False, info

    def close(self) -> None:
        pass


def test_the_planners_record_says_why_a_motion_was_not_carried_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(evaluating, "_planned", lambda spec: SimpleNamespace(targets=[np.zeros(7)]))
    monkeypatch.setattr(evaluating, "make_env", lambda *_, **__: Refusing())
    record = replay(metadata.episode("VideoUnmask", "val", 0), max_steps=500)
    assert record.outcome == "fail" and record.extra["status"] == "error"
    assert record.refused == "no path to the pose"
