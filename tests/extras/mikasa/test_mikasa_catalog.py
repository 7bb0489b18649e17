"""The catalog of MIKASA-Robo-VLA, and what is said where a model or the package is missing."""

from pathlib import Path

import pytest

from mme_vla import errors
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes
from mme_vla.errors import UserError
from mme_vla.extras.mikasa import assets, catalog
from mme_vla.extras.mikasa.catalog import BULB, FAMILIES, FAMILY_OF, STEPS, YCB


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A machine with the package and no further models; the folder in which they belong."""
    monkeypatch.setattr(assets, "bulb_file", lambda: tmp_path / "low_poly_light_bulb.glb")
    monkeypatch.setattr(assets, "find_spec", lambda name: object())
    monkeypatch.setenv("MS_ASSET_DIR", str(tmp_path))
    return tmp_path


def test_the_catalog_has_the_benchmarks_numbers() -> None:
    kinds = {kind: len(tasks) for kind, tasks in catalog.by_memory().items()}
    assert kinds == {
        "Object": 18, "Spatial": 14, "Capacity": 12, "Temporal": 12, "Negative": 9,
        "Sequential": 6, "Procedural": 6, "Prospective": 5, "Tracking": 4, "Checklist": 4,
    }  # fmt: skip
    horizons = {name: len(tasks) for name, tasks in catalog.by_horizon().items()}
    assert horizons == {"Short": 38, "Medium": 30, "Long": 22}
    needs = [FAMILY_OF[task].needs for task in STEPS]
    assert {need: needs.count(need) for need in needs} == {
        (): 56, (BULB,): 27, (YCB,): 4, (BULB, YCB): 3,
    }  # fmt: skip


def test_tasks_are_those_whose_models_are_there(bare: Path) -> None:
    source = environment("mikasa")
    assert len(source.tasks) == sum(len(f.tasks) for f in FAMILIES.values() if not f.needs)
    (bare / "low_poly_light_bulb.glb").touch()
    assert "TraceShapeEasy" in source.tasks and "ShellGameTouch" not in source.tasks
    models = bare / "data" / "assets" / "mani_skill2_ycb" / "info_pick_v0.json"
    models.parent.mkdir(parents=True)
    models.touch()
    assert len(source.tasks) == 90
    (bare / "low_poly_light_bulb.glb").unlink()
    assert len(source.tasks) == 60 and "ShellGameColorLampTouch" not in source.tasks


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ("TraceShapeEasy", r"low_poly_light_bulb\.glb.*MIKASA-Robo.*CC BY 4\.0.*Copy it to"),
        ("ShellGameTouch", r"YCB models.*mani_skill2_ycb.*download_asset ycb"),
        ("ShellGameColorLampTouch", r"low_poly_light_bulb\.glb"),
        ("TraceShapeEezy", "Did you mean"),
    ],
)
def test_a_task_without_its_models_says_where_they_come_from(
    bare: Path, task: str, words: str
) -> None:
    with pytest.raises(UserError, match=words) as raised:
        choose_episodes([task], 1, "test", "mikasa")
    if "mean" not in words:
        assert str(bare) in str(raised.value)


def test_seeds_are_the_protocols_and_limits_the_tasks() -> None:
    source = environment("mikasa")
    test = source.episodes("RememberColor3", "test")
    assert [len(test), test[0].seed, test[-1].seed] == [50, 4_242_424_242, 4_242_424_291]
    train = {spec.seed for spec in source.episodes("RememberColor3", "train")}
    assert len(train) == 250 and not train & {spec.seed for spec in test}
    assert source.task_limit("FindImposterShapeAndColor5x3", "test") == 40
    assert source.step_limit("test") == 2160
    assert source.groups_of("SeqOfColors3-Long") == {"horizon": "Long"}
    assert source.suite_of("SeqOfColors3-Long") == "Capacity"


def test_without_the_package_both_ways_to_install_it_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(assets, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"uv sync --inexact --extra mikasa .*--no-deps"):
        environment("mikasa").check_installed()


def test_users_of_the_wheel_are_told_what_pip_accepts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(assets, "find_spec", lambda name: None)
    monkeypatch.setattr(errors, "CONSTRAINTS", tmp_path / "constraints.txt")
    with pytest.raises(UserError) as refusal:
        environment("mikasa").check_installed()
    message = str(refusal.value)
    assert "pip install 'mme-vla[sim]' colorama, then pip install --no-deps" in message
    assert "uv" not in message and "clone" not in message
