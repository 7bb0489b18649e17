"""Snapshots of a scene: images rendered afterwards are those that the episode shows."""

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.extras.nano.demonstrations import record


def test_marks_and_traces_are_rendered_as_the_episode_showed_them() -> None:
    """Marks come and go, and belong to no thing of the task: an image rendered afterwards has them
    where they were.
    """
    from mme_vla.envs.make import make_env
    from mme_vla.envs.observations import RenderRequest
    from mme_vla.envs.robomme.recording.frames import FrameChoice

    remembered = {"name": "framesamp", "budget": 16, "grid": 1, "every": 7}
    made = record(
        "PatternLock", 3_000_001, "easy", [FrameChoice("decisions", remembered)], ["front"]
    )
    assert made is not None
    env = make_env("PatternLock", seed=3_000_001, difficulty="easy", action_space="waypoint")
    images = made.images["front"]
    env.render_request = RenderRequest({"front": images}, now=())
    try:
        frames = env.reset()[0]["front_rgb_list"]
    finally:
        env.close()
    assert made.exec_start == len(frames) - 1 and len(images) > 3
    for frame, image in images.items():
        if frame < made.exec_start:
            assert np.abs(image.astype(int) - frames[frame]).max() <= 2, frame
