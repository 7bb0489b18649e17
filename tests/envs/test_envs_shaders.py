"""Cameras draw without the table for environment maps, and draw the same; where there is such a map they use it."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim")

import sapien
from PIL import Image

from helpers.env_scenes import Scene
from mme_vla.envs import rendering as shaders
from mme_vla.envs.rendering import PACK, render_backend, without_table
from mme_vla.envs.scene import stage
from mme_vla.errors import UserError

STOCK = Path(sapien.__file__).parent / "vulkan_shader" / PACK


@pytest.fixture(scope="module")
def rendering() -> dict[str, object]:
    """How a scene is made that draws in software."""
    try:
        backend = render_backend()
    except UserError as error:
        pytest.skip(f"cannot render here: {error}")
    if backend != "sapien_cpu":
        pytest.skip("the table costs nothing worth saving on a GPU, where the stock shaders are used")
    return {"obs_mode": "rgb+depth+segmentation", "render_backend": backend}


def pack(scene: Scene) -> str:
    return scene.scene.sensors["base_camera"].config.shader_config.shader_pack


def seen(scene: Scene) -> dict[str, np.ndarray]:
    observed = scene.get_obs()["sensor_data"]
    return {f"{view}.{kind}": value.numpy() for view, kinds in observed.items() for kind, value in kinds.items()}


def test_images_depth_and_segmentation_are_those_of_the_stock_shaders(
    rendering: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    lean = Scene(lambda _: None, **rendering)
    lean.reset()
    monkeypatch.setattr(stage, "lean_shaders", lambda: None)
    stock = Scene(lambda _: None, **rendering)
    stock.reset()
    assert pack(lean) != PACK == pack(stock)
    actual, stock_images = seen(lean), seen(stock)
    assert actual.keys() == stock_images.keys() and any(name.endswith("segmentation") for name in actual)
    for name, values in stock_images.items():
        assert np.array_equal(actual[name], values), name
    lean.close()
    stock.close()


def test_a_scene_with_an_environment_map_keeps_the_stock_shaders(rendering: dict[str, object], tmp_path: Path) -> None:
    faces = [str(tmp_path / f"{face}.png") for face in range(6)]
    for face in faces:
        Image.new("RGBA", (4, 4), "white").save(face)

    def lit(scene: Scene) -> None:
        scene.scene.sub_scenes[0].render_system.cubemap = sapien.render.RenderCubemap(*faces)

    scene = Scene(lit, **rendering)
    assert pack(scene) == PACK
    scene.close()


def test_asking_for_other_shaders_is_noticed(rendering: dict[str, object]) -> None:
    scene = Scene(lambda _: None, sensor_configs={"shader_pack": "default"}, **rendering)
    assert pack(scene) == "default"
    scene.close()


def test_nothing_but_the_table_leaves_the_shaders() -> None:
    for file in STOCK.glob("*.frag"):
        before = file.read_text().splitlines()
        after = without_table(file.read_text()).splitlines()
        changed = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
        assert all("samplerBRDFLUT" in old and "samplerBRDFLUT" not in new for old, new in changed)


def test_shaders_that_are_not_known_are_used_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shaders, "without_table", lambda text: text)
    shaders._pipeline_folder.cache_clear()
    assert shaders.lean_shaders() is None
    shaders._pipeline_folder.cache_clear()
