"""The simulator, and models that stand in for those which scenes of MIKASA-Robo-VLA lack."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from mme_vla.envs import base
from mme_vla.extras.mikasa import assets


@pytest.fixture
def simulator() -> Iterator[None]:
    pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim`")
    pytest.importorskip(
        "mikasa_robo_suite", reason="MIKASA-Robo-VLA is not installed: the extra `mikasa`"
    )
    yield
    while base._idle:
        base._idle.popitem()[1].close()


@pytest.fixture
def lamp_model(simulator: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A white ball of 0.05 m, which hides little, in place of the model of the lamps."""
    import trimesh
    from mikasa_robo_suite.vla.utils import shapes
    from trimesh.visual.material import PBRMaterial

    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.05)
    ball.visual = trimesh.visual.TextureVisuals(material=PBRMaterial(baseColorFactor=[255] * 4))
    model = tmp_path / "objects" / assets.bulb_file().name
    model.parent.mkdir()
    ball.export(model)
    # The package looks beside its module, the library in the package.
    monkeypatch.setattr(shapes, "__file__", str(tmp_path / "shapes.py"))
    monkeypatch.setattr(assets, "bulb_file", lambda: model)


@pytest.fixture
def cup_model(simulator: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cylinder in place of the mug of ManiSkill's YCB models, 0.08 m high."""
    import mikasa_robo_suite.vla.memory_envs as scenes
    import trimesh
    from mani_skill.utils.assets import DATA_SOURCES
    from mani_skill.utils.building.actors import ycb

    data = tmp_path / "data"
    folder = data / DATA_SOURCES["ycb"].target_path
    mug = folder / "models" / "025_mug"
    mug.mkdir(parents=True)
    bounds = {"min": [-0.045, -0.045, -0.04], "max": [0.045, 0.045, 0.04]}
    known = {mug.name: {"bbox": bounds, "scales": [1.0]}}
    (folder / "info_pick_v0.json").write_text(json.dumps(known))
    cylinder = trimesh.creation.cylinder(radius=0.045, height=0.08, sections=12)
    cylinder.export(mug / "collision.ply")
    cylinder.export(mug / "textured.obj")
    # Each module of the simulator has read the folder's name when it was imported.
    monkeypatch.setenv("MS_ASSET_DIR", str(tmp_path))
    monkeypatch.setattr(DATA_SOURCES["ycb"], "output_dir", data)
    for module in (ycb, *vars(scenes).values()):
        if hasattr(module, "ASSET_DIR"):
            monkeypatch.setattr(module, "ASSET_DIR", data)
