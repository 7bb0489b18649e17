"""Environments that are told what to draw: the same simulation, the same images, and no others."""

from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.envs import make_env
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.rendering import render_backend
from mme_vla.errors import UserError

HOLD = np.array([0, 0, 0, -np.pi / 2, 0, np.pi / 2, np.pi / 4, 1], np.float32)
DOWN = np.array([-0.0605, 0, 0.47, np.pi, 0, 0, -1], np.float32)


@pytest.fixture(scope="module", autouse=True)
def renderer() -> None:
    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))


def episode(
    space: str, actions: list[np.ndarray], render_request: RenderRequest | None
) -> tuple[dict[str, list[Any]], list[Any]]:
    """All frames of an episode, in order, and the infos."""
    env = make_env("PickXtimes", episode=0, action_space=space)
    env.render_request = render_request
    observation, info = env.reset()
    frames, infos = dict(observation), [info]
    for action in actions:
        observation, *_, info = env.step(action)
        frames = {key: [*values, *observation[key]] for key, values in frames.items()}
        infos.append(info)
    env.close()
    return frames, infos


def displayed(frames: dict[str, list[Any]], camera: str) -> list[int]:
    return [k for k, image in enumerate(frames[f"{camera}_rgb_list"]) if image is not None]


@pytest.mark.parametrize(("space", "actions"), [("joint_angle", [HOLD] * 4), ("waypoint", [DOWN])])
def test_frames_are_rendered_where_they_are_requested(space: str, actions: list[np.ndarray]) -> None:
    full, infos = episode(space, actions, None)
    count = len(full["joint_state_list"])
    # The newest frame of each call: of a motion with a grip at its end the last one, which nobody can count beforehand.
    render_request = RenderRequest({"front": frozenset({2, 3})}, now=("wrist",), grounded=False)
    some, fewer = episode(space, actions, render_request)
    assert displayed(full, "front") == displayed(full, "wrist") == list(range(count))
    assert displayed(some, "front") == [2, 3]
    assert displayed(some, "wrist") == (list(range(count)) if space == "joint_angle" else [0, count - 1])
    for key in ("joint_state_list", "eef_state_list", "gripper_state_list"):
        assert np.array_equal(full[key], some[key])
    for camera in ("front", "wrist"):
        key = f"{camera}_rgb_list"
        assert all(np.array_equal(full[key][k], some[key][k]) for k in displayed(some, camera))
    assert all("grounded_subgoal_online" not in info for info in fewer)
    assert [info["status"] for info in fewer] == [info["status"] for info in infos]


def test_a_text_with_pixels_renders_its_frame() -> None:
    (_, full), (frames, blind) = (
        episode("joint_angle", [HOLD], render_request) for render_request in (None, RenderRequest(now=()))
    )
    assert displayed(frames, "front") == displayed(frames, "wrist") == []
    texts = [info["grounded_subgoal_online"] for info in full]
    assert "<" in texts[0] and texts == [info["grounded_subgoal_online"] for info in blind]
