"""Images of the environment against official ones; needs Vulkan, software rendering suffices."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim")
h5py = pytest.importorskip("h5py")

from mme_vla.envs import make_env  # noqa: E402
from mme_vla.envs.rendering import render_backend  # noqa: E402
from mme_vla.errors import UserError  # noqa: E402


@pytest.fixture(scope="module")
def _can_render() -> None:
    try:
        render_backend()
    except UserError as error:
        pytest.skip(f"cannot render here: {error}")


@pytest.mark.usefixtures("_can_render")
def test_the_first_frame_and_its_grounded_text_are_the_official_ones(h5_folder: Path) -> None:
    path = h5_folder / "record_dataset_PickXtimes.h5"
    if not path.is_file():
        pytest.skip(f"no official episode of PickXtimes in {h5_folder}")
    with h5py.File(path) as file:
        name = min(file)
        first = file[name]["timestep_0"]
        official = {key: first[f"obs/{key}"][()] for key in ("front_rgb", "wrist_rgb", "front_depth", "wrist_depth")}
        text = first["info/grounded_subgoal_online"][()].decode()
    depth = {"include_front_depth": True, "include_wrist_depth": True}
    env = make_env("PickXtimes", "train", int(name.removeprefix("episode_")), **depth)
    observation, info = env.reset()
    rendered = env.render()
    env.close()
    assert info["grounded_subgoal_online"] == text
    for key, expected in official.items():
        (actual,) = observation[f"{key}_list"]
        assert (actual.dtype, actual.shape) == (expected.dtype, expected.shape), key
        difference = float(np.abs(actual.astype(float) - expected).mean())
        assert difference < 1, f"{key}: mean absolute difference {difference}"
    np.testing.assert_array_equal(rendered, observation["front_rgb_list"][-1])
