"""Policies that execute several motions of a chunk are asked at every so many decisions, and learn
those alone.
"""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mme_vla import UserError, build_policy
from mme_vla.data.waypoints import Motions
from mme_vla.envs.robomme.recording.frames import DECISIONS as AT_DECISIONS
from mme_vla.envs.robomme.recording.frames import FrameChoice
from mme_vla.extras.nano.demonstrations import Demonstration, Scene
from mme_vla.extras.nano.learning import Decisions, statistics
from mme_vla.policy.mme import MMEPolicy

ROWS = {"framesamp": 73, "pi05": 3, "planner": 100}
DECISIONS = np.array([20, 40, 60, 80, 100])


def policy(execute: int) -> MMEPolicy:
    return build_policy(
        "framesamp_modul",
        backbone="nano",
        embodiment="robomme_waypoint_front_route",
        policy={"augment": False},
        memory={"budget": 32, "grid": 1, "every": 8},
        **{"embodiment.action.execute": execute},
    )


def demonstration(frames: range | list[int]) -> Demonstration:
    rng = np.random.default_rng(0)
    images = {frame: rng.integers(0, 256, (256, 256, 3), dtype=np.uint8) for frame in frames}
    motions = Motions(DECISIONS, rng.uniform(-0.2, 0.2, (5, 7)).astype(np.float32))
    states = rng.uniform(-1, 1, (120, 8)).astype(np.float32)
    return Demonstration(
        "RouteStick",
        3,
        "easy",
        "follow the same path",
        120,
        20,
        states,
        motions,
        {"front": images},
        boundaries=np.array([0]),
    )


@pytest.mark.parametrize(("execute", "queries"), [(1, [0, 1, 2, 3, 4]), (2, [0, 2, 4]), (14, [0])])
def test_what_is_executed_without_asking_again_is_no_decision_to_learn(
    execute: int, queries: list[int]
) -> None:
    routed, made = policy(execute), demonstration(range(120))
    routed.require_processor().stats = statistics([made], routed)
    samples = Decisions.of(routed, [made])
    batch = samples.collate(range(len(queries)))
    assert len(samples.batch.prompt) == len(samples.distant) == len(queries)
    assert batch.state is not None and batch.action_mask is not None
    assert np.array_equal(batch.state.numpy(), made.states[DECISIONS[queries]])
    assert batch.action_mask.sum(1).tolist() == [5 - place for place in queries]


def test_a_route_decided_at_once_needs_the_frames_before_it_alone() -> None:
    routed, video = policy(14), demonstration([0, 7, 15, 20])
    routed.require_processor().stats = statistics([video], routed)
    assert len(Decisions.of(routed, [video])) == 1
    with pytest.raises(UserError, match="holds no tokens"):
        Decisions.of(routed, [demonstration([0, 7, 20])])


def test_few_decisions_are_blurred_as_they_are_learned_and_measured_as_they_are() -> None:
    routed, made = policy(1), demonstration(range(120))
    routed.require_processor().stats = statistics([made], routed)
    sharp, blurred = (Decisions.of(routed, [made], token_noise=size) for size in (0.0, 0.5))
    now, same, other = (
        blurred.collate([0, 1, 2]),
        blurred.collate([0, 1, 2]),
        blurred.collate([2, 1, 0]),
    )
    batch = sharp.collate([0, 1, 2])
    assert now.view_tokens is not None and batch.view_tokens is not None and now.history is not None
    assert (
        same.view_tokens is not None and other.view_tokens is not None and batch.history is not None
    )
    assert torch.equal(now.view_tokens, same.view_tokens)
    assert not torch.equal(now.view_tokens[1], other.view_tokens[1])
    std = sharp.batch.view_tokens.float().flatten(0, -2).std(0)  # type: ignore[union-attr]
    off = (now.view_tokens.float() - batch.view_tokens.float()).flatten(0, -2).std(0)
    assert torch.allclose(off[std > 0.01], 0.5 * std[std > 0.01], rtol=0.4)
    assert torch.equal(now.history.mask, batch.history.mask)
    assert not torch.equal(now.history.features, batch.history.features)


def step(number: int, video: int) -> SimpleNamespace:
    """A recorded step of an execution in which a motion takes two frames."""
    row = np.full(7, np.nan) if number < video else np.full(7, (number - video) // 2, np.float64)
    actions = {"waypoint_action": row, "eef_action": np.zeros(7)}
    return SimpleNamespace(action=actions, info={"is_video_demo": number < video})


@pytest.mark.parametrize(("every", "rendered"), [(1, {3, 4, 6, 8}), (2, {3, 6}), (14, {3})])
def test_only_decisions_that_a_policy_is_requested_are_rendered(
    every: int, rendered: set[int]
) -> None:
    steps = [step(number, 3) for number in range(11)]
    selection = FrameChoice(AT_DECISIONS, None, every).render_request(steps)  # type: ignore[arg-type]
    assert set(selection.frames["front"]) == rendered


@pytest.mark.parametrize("missing", ["carried_out", "boundaries"])
def test_a_demonstration_of_an_earlier_version_is_to_be_recorded_again(
    missing: str, tmp_path: Path
) -> None:
    scene = Scene("RouteStick", 3, "easy", tmp_path, ("front",), ())
    demonstration([0]).save(scene.path)
    with np.load(scene.path) as file:
        arrays = {name: file[name] for name in file if name != missing}
    about = json.loads(str(arrays["about"]))
    about.pop(missing, None)
    np.savez(scene.path, **arrays | {"about": np.array(json.dumps(about))})
    for read in (lambda: Demonstration.load(scene.path), lambda: scene.tried):
        with pytest.raises(UserError, match="of an earlier version: remove it and record it again"):
            read()
