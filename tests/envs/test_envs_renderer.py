"""The renderer outlives its environments: later episodes find it, and look the same."""

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim")

from mme_vla.envs import make_env, rendering
from mme_vla.envs.rendering import render_backend, renderer_works
from mme_vla.errors import UserError


@pytest.fixture(scope="module", autouse=True)
def _can_render() -> None:
    try:
        render_backend()
    except UserError as error:
        pytest.skip(f"cannot render here: {error}")


def first_images(episode: int) -> np.ndarray:
    """Front and wrist image an episode begins with, [2, 256, 256, 3]; its environment is gone afterwards."""
    env = make_env("PickXtimes", "test", episode)
    observation, _ = env.reset()
    env.close()
    return np.stack([observation[f"{view}_rgb_list"][-1] for view in ("front", "wrist")])


def test_later_episodes_find_the_renderer_of_the_first_and_an_episode_renders_the_same_again() -> None:
    first = first_images(0)
    cached = dict(rendering._systems)
    assert cached, "the renderer went with the scene"
    other = first_images(1)
    assert rendering._systems == cached
    assert not np.array_equal(first, other)
    assert np.array_equal(first, first_images(0))


def test_a_renderer_that_takes_no_more_images_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    first_images(0)
    assert renderer_works()

    def lost(_: object) -> None:
        raise RuntimeError("vk::Queue::submit: ErrorDeviceLost")

    monkeypatch.setattr("mme_vla.envs.rendering._render_once", lost)
    assert not renderer_works()
