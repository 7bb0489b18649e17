"""The wrist camera's body is drawn with fewer triangles, and the images stay the same."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim")

from mme_vla.envs import make_env
from mme_vla.envs.rendering import render_backend
from mme_vla.envs.robot import robots
from mme_vla.envs.robot.robots import CELL, coarsen, read_stl, stl_bytes
from mme_vla.errors import UserError

SQUARE = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]], np.float32)
SHOWN_FROM_THE_FRONT = np.array([-0.06, 0.356, -0.323, -2.108, -0.115, 1.209, 0.294, 0.04, 0.04], np.float32)


def test_a_coarse_mesh_is_left_as_it_is_and_a_fine_one_loses_what_lies_in_one_cell() -> None:
    same = coarsen(SQUARE, 0.4)
    assert {frozenset(map(tuple, triangle)) for triangle in same} == {
        frozenset(map(tuple, triangle)) for triangle in SQUARE
    }
    assert (np.cross(same[:, 1] - same[:, 0], same[:, 2] - same[:, 0]) == [0, 0, 1]).all(), "a triangle was turned over"
    tiny = SQUARE * 0.1 + 5
    assert len(coarsen(np.concatenate([SQUARE, tiny]), 0.4)) == 2
    assert len(coarsen(tiny, 0.4)) == 0


def test_duplicate_triangles_remain_once_for_each_side() -> None:
    nearly = SQUARE[:1] + np.float32(0.01)
    turned = np.roll(SQUARE[:1], 1, axis=1)
    back = SQUARE[:1, ::-1]
    assert len(coarsen(np.concatenate([SQUARE[:1], nearly, turned]), 0.4)) == 1
    assert len(coarsen(np.concatenate([SQUARE[:1], back]), 0.4)) == 2


def test_a_mesh_file_is_read_as_saved(tmp_path: Path) -> None:
    path = tmp_path / "square.stl"
    path.write_bytes(stl_bytes(SQUARE))
    np.testing.assert_array_equal(read_stl(path), SQUARE)
    with pytest.raises(ValueError):
        path.write_bytes(stl_bytes(SQUARE)[:-1])
        read_stl(path)


def test_the_cameras_body_keeps_its_size_and_a_twentieth_of_its_triangles() -> None:
    stock = read_stl(Path(robots.PandaWristCam.urdf_path).parent / "realsense2_description" / "meshes" / "d415.stl")
    coarse = coarsen(stock)
    assert len(coarse) < len(stock) / 20
    for extreme in (np.min, np.max):
        np.testing.assert_allclose(extreme(coarse, (0, 1)), extreme(stock, (0, 1)), atol=CELL)


def test_images_are_equal_and_where_the_body_shows_all_but_equal(monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))
    coarse, n_visible = pictures()
    monkeypatch.setattr(robots, "_CAMERA_MESH", "none")
    robots.description.cache_clear()
    stock, _ = pictures()
    robots.description.cache_clear()
    assert n_visible > 100, "the body was not seen at all"
    np.testing.assert_array_equal(coarse[0], stock[0])
    assert np.abs(coarse[1].astype(int) - stock[1]).mean() < 0.01


def pictures() -> tuple[np.ndarray, int]:
    """Both views [2, 2, 256, 256, 3] at rest and with the body in the front view; pixels of it in the latter."""
    env: Any = make_env("PickXtimes", "test", 0)
    env.reset()
    task = env.task
    body = task.agent.robot.links_map["camera_link"]._objs[0].entity.per_scene_id
    images = []
    for qpos in (task.qpos, SHOWN_FROM_THE_FRONT):
        task.agent.robot.set_qpos(qpos[None])
        frame = env._observer.frame({})
        images.append(np.stack([frame["front_rgb"], frame["wrist_rgb"]]))
    n_pixels = int((env._observer.segmentation() == body).sum())
    env.close()
    return np.stack(images), n_pixels
