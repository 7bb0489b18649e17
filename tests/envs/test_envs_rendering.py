"""Images: rendered where they are requested, by a renderer that stays, equal without what no camera
sees.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import sapien
from PIL import Image
from sapien.render import RenderBodyComponent

from helpers.env_scenes import Scene
from mme_vla.envs import make_env, rendering
from mme_vla.envs.observations import SENSORS, RenderRequest, capture, read_images
from mme_vla.envs.rendering import PACK, links_culled, without_table
from mme_vla.envs.robomme.robot import robots
from mme_vla.envs.robomme.robot.robots import CELL, coarsen, read_stl, stl_bytes
from mme_vla.envs.robomme.scene import stage

HOLD = np.array([0, 0, 0, -np.pi / 2, 0, np.pi / 2, np.pi / 4, 1], np.float32)
DOWN = np.array([-0.0605, 0, 0.47, np.pi, 0, 0, -1], np.float32)
STOCK = Path(sapien.__file__).parent / "vulkan_shader" / PACK
SQUARE = np.array(
    [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]], np.float32
)
FACING_THE_CAMERA = np.array(
    [-0.06, 0.356, -0.323, -2.108, -0.115, 1.209, 0.294, 0.04, 0.04], np.float32
)

# Requests -----------------------------------------------------------------------------------------


def run_episode(
    space: str, actions: list[np.ndarray], request: RenderRequest | None
) -> tuple[dict[str, list[Any]], list[Any]]:
    """All frames of an episode, in order, and the infos."""
    env = make_env("PickXtimes", episode=0, action_space=space)
    env.render_request = request
    observation, info = env.reset()
    frames, infos = dict(observation), [info]
    for action in actions:
        observation, *_, info = env.step(action)
        frames = {key: [*values, *observation[key]] for key, values in frames.items()}
        infos.append(info)
        assert np.array_equal(env.render(), observation["front_rgb_list"][-1])
    env.close()
    return frames, infos


def displayed(frames: dict[str, list[Any]], camera: str) -> list[int]:
    return [k for k, image in enumerate(frames[f"{camera}_rgb_list"]) if image is not None]


@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize(("space", "actions"), [("joint_angle", [HOLD] * 4), ("waypoint", [DOWN])])
def test_frames_are_rendered_where_they_are_requested(
    space: str, actions: list[np.ndarray]
) -> None:
    full, infos = run_episode(space, actions, None)
    count = len(full["joint_state_list"])
    # The newest frame of each call. The number of the last frame of a motion that ends with a grip
    # is unknown before.
    request = RenderRequest({"front": frozenset({2, 3})}, now=("wrist",), grounded=False)
    some, fewer = run_episode(space, actions, request)
    assert displayed(full, "front") == displayed(full, "wrist") == list(range(count))
    assert displayed(some, "front") == [2, 3]
    assert displayed(some, "wrist") == (
        list(range(count)) if space == "joint_angle" else [0, count - 1]
    )
    for key in ("joint_state_list", "eef_state_list", "gripper_state_list"):
        assert np.array_equal(full[key], some[key])
    for camera in ("front", "wrist"):
        key = f"{camera}_rgb_list"
        assert all(np.array_equal(full[key][k], some[key][k]) for k in displayed(some, camera))
    assert all("grounded_subgoal_online" not in info for info in fewer)
    assert [info["status"] for info in fewer] == [info["status"] for info in infos]


@pytest.mark.usefixtures("renderer")
def test_a_text_with_pixels_renders_its_frame() -> None:
    (_, full), (frames, blind) = (
        run_episode("joint_angle", [HOLD], request) for request in (None, RenderRequest(now=()))
    )
    assert displayed(frames, "front") == displayed(frames, "wrist") == []
    texts = [info["grounded_subgoal_online"] for info in full]
    assert "<" in texts[0] and texts == [info["grounded_subgoal_online"] for info in blind]


# The renderer's life ------------------------------------------------------------------------------


def first_images(episode: int) -> np.ndarray:
    """Front and wrist image an episode begins with, [2, 256, 256, 3]; its environment is gone
    afterwards.
    """
    env = make_env("PickXtimes", "test", episode)
    observation, _ = env.reset()
    env.close()
    return np.stack([observation[f"{view}_rgb_list"][-1] for view in ("front", "wrist")])


@pytest.mark.usefixtures("renderer")
def test_later_episodes_use_the_renderer_of_the_first() -> None:
    first = first_images(0)
    cached = dict(rendering._systems)
    assert cached, "the renderer went with the scene"
    other = first_images(1)
    assert rendering._systems == cached
    assert not np.array_equal(first, other)
    assert np.array_equal(first, first_images(0))


# Shaders ------------------------------------------------------------------------------------------


@pytest.fixture
def software(renderer: str) -> dict[str, object]:
    """Options of a scene that renders on the CPU."""
    if renderer != "sapien_cpu":
        pytest.skip(
            "the table costs nothing worth saving on a GPU, where the stock shaders are used"
        )
    return {"obs_mode": "rgb+depth+segmentation", "render_backend": renderer}


def pack(scene: Scene) -> str:
    return scene.scene.sensors["base_camera"].config.shader_config.shader_pack


def sensor_images(scene: Scene) -> dict[str, np.ndarray]:
    scene.reset()
    observed = scene.get_obs()["sensor_data"]
    return {
        f"{view}.{kind}": value.numpy()
        for view, kinds in observed.items()
        for kind, value in kinds.items()
    }


@pytest.mark.slow
def test_images_depth_and_segmentation_are_those_of_the_stock_shaders(
    software: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    lean = Scene(lambda _: None, **software)
    monkeypatch.setattr(stage, "lean_shaders", lambda: None)
    stock = Scene(lambda _: None, **software)
    assert pack(lean) != PACK == pack(stock)
    actual, expected = sensor_images(lean), sensor_images(stock)
    assert actual.keys() == expected.keys() and any(
        name.endswith("segmentation") for name in actual
    )
    for name, values in expected.items():
        assert np.array_equal(actual[name], values), name
    lean.close()
    stock.close()


def test_scenes_with_an_environment_map_or_other_shaders_keep_them(
    software: dict[str, object], tmp_path: Path
) -> None:
    faces = [str(tmp_path / f"{face}.png") for face in range(6)]
    for face in faces:
        Image.new("RGBA", (4, 4), "white").save(face)

    def lit(scene: Scene) -> None:
        scene.scene.sub_scenes[0].render_system.cubemap = sapien.render.RenderCubemap(*faces)

    selection = {"sensor_configs": {"shader_pack": "default"}}
    for fill, options, expected in ((lit, {}, PACK), (lambda _: None, selection, "default")):
        scene = Scene(fill, **options, **software)
        assert pack(scene) == expected
        scene.close()


def test_nothing_but_the_table_leaves_the_shaders_and_unknown_ones_are_unchanged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for file in STOCK.glob("*.frag"):
        before = file.read_text().splitlines()
        after = without_table(file.read_text()).splitlines()
        changed = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
        assert all("samplerBRDFLUT" in old and "samplerBRDFLUT" not in new for old, new in changed)
    monkeypatch.setattr(rendering, "without_table", lambda text: text)
    rendering._pipeline_folder.cache_clear()
    assert rendering.lean_shaders() is None
    rendering._pipeline_folder.cache_clear()


# What is out of sight -----------------------------------------------------------------------------


def test_hiding_links_out_of_sight_and_reading_without_a_copy_change_no_pixel(
    software: dict[str, object],
) -> None:
    scene = Scene(lambda _: None, **software)
    scene.reset()
    rng, hidden = np.random.default_rng(0), Counter[str]()
    for _ in range(6):
        offset = np.append(rng.uniform(-0.6, 0.6, 7), [0, 0]).astype(np.float32)
        scene.agent.robot.set_qpos(FACING_THE_CAMERA + offset)
        for name, sensor_name in SENSORS.items():
            capture(scene, [name])
            actual = read_images(scene, name, rgb=True, depth=True, segmentation=True)
            sensor = scene.scene.sensors[sensor_name]
            with links_culled(scene, sensor.camera):
                bodies = [
                    entity.find_component_by_type(RenderBodyComponent) for entity in links(scene)
                ]
                hidden[name] += sum(body is not None and not body.visibility for body in bodies)
            assert all(body is None or body.visibility == 1 for body in bodies)
            sensor.capture()
            for kind, image in sensor.get_obs(position=False).items():
                assert np.array_equal(actual[kind], image[0].numpy()), (name, kind)
    assert hidden["front"] > 18 and hidden["wrist"] > 18, "few of 6 x 12 links are ever hidden"
    scene.close()


def links(scene: Scene) -> list[sapien.Entity]:
    return [link._objs[0].entity for link in scene.agent.robot.links]


# Meshes -------------------------------------------------------------------------------------------


def test_a_coarse_mesh_is_left_as_it_is_and_a_fine_one_loses_what_lies_in_one_cell() -> None:
    same = coarsen(SQUARE, 0.4)
    as_sets = [{frozenset(map(tuple, triangle)) for triangle in mesh} for mesh in (same, SQUARE)]
    assert as_sets[0] == as_sets[1]
    assert (np.cross(same[:, 1] - same[:, 0], same[:, 2] - same[:, 0]) == [0, 0, 1]).all(), (
        "a triangle was turned over"
    )
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
    path.write_bytes(stl_bytes(SQUARE)[:-1])
    with pytest.raises(ValueError):
        read_stl(path)


@pytest.mark.slow
def test_the_cameras_body_keeps_its_size_and_a_twentieth_of_its_triangles() -> None:
    stock = read_stl(
        Path(robots.PandaWristCam.urdf_path).parent
        / "realsense2_description"
        / "meshes"
        / "d415.stl"
    )
    coarse = coarsen(stock)
    assert len(coarse) < len(stock) / 20
    for extreme in (np.min, np.max):
        np.testing.assert_allclose(extreme(coarse, (0, 1)), extreme(stock, (0, 1)), atol=CELL)


@pytest.mark.usefixtures("renderer")
def test_images_are_equal_and_where_the_body_shows_all_but_equal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    coarse, n_visible = images_of_the_body()
    monkeypatch.setattr(robots, "_CAMERA_MESH", "none")
    robots.description.cache_clear()
    stock, _ = images_of_the_body()
    robots.description.cache_clear()
    assert n_visible > 100, "the body was not seen at all"
    np.testing.assert_array_equal(coarse[0], stock[0])
    assert np.abs(coarse[1].astype(int) - stock[1]).mean() < 0.01


def images_of_the_body() -> tuple[np.ndarray, int]:
    """Both views [2, 2, 256, 256, 3] at rest and with the body in the front view; pixels of it in
    the latter.
    """
    env: Any = make_env("PickXtimes", "test", 0)
    env.reset()
    task = env.task
    body = task.agent.robot.links_map["camera_link"]._objs[0].entity.per_scene_id
    images = []
    for qpos in (task.qpos, FACING_THE_CAMERA):
        task.agent.robot.set_qpos(qpos[None])
        frame = env._run.observer.frame({})
        images.append(np.stack([frame["front_rgb"], frame["wrist_rgb"]]))
    n_pixels = int((env._run.observer.segmentation() == body).sum())
    env.close()
    return np.stack(images), n_pixels
