"""plugins/robomme: the official package's import surface over this library's environments."""

import importlib
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from helpers.plugins import plugin
from mme_vla.envs import make_env, metadata
from mme_vla.envs.observations import Include
from mme_vla.errors import UserError

pytest.importorskip(
    "mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim"
)


@pytest.fixture
def wrapper() -> Iterator[ModuleType]:
    with plugin("robomme", "robomme"):
        yield importlib.import_module("robomme.env_record_wrapper")


def test_it_is_refused_beside_the_official_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    official = tmp_path / "robomme-0.1.0.dist-info"
    official.mkdir()
    (official / "METADATA").write_text("Metadata-Version: 2.1\nName: robomme\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match="are both installed"), plugin("robomme", "robomme"):
        pass


def test_the_builder_knows_the_benchmarks_episodes(wrapper: ModuleType) -> None:
    builder = wrapper.BenchmarkEnvBuilder(
        "VideoUnmask", dataset="test", action_space="ee_pose", max_steps=7
    )
    known = metadata.episodes("VideoUnmask", "test")
    assert wrapper.BenchmarkEnvBuilder.get_task_list()[:2] == ["PickXtimes", "StopCube"]
    assert len(builder.get_task_list()) == 16
    assert builder.get_episode_num() == len(known) == 50
    assert builder.resolve_episode(49) == (known[49].seed, known[49].difficulty)
    with pytest.raises(UserError, match="0 to 49, and no 50"):
        builder.make_env_for_episode(50)
    with pytest.raises(UserError, match="include_front_depth"):
        builder.make_env_for_episode(0, include_depth=True)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"env_id": "VideoUnmaks"}, "Did you mean 'VideoUnmask'"),
        ({"env_id": "StopCube", "dataset": "tests"}, "Did you mean 'test'"),
        ({"env_id": "StopCube", "action_space": "keypoint"}, "Unknown action space 'keypoint'"),
        ({"env_id": "StopCube", "gui_render": True}, "open no window"),
    ],
)
def test_what_cannot_be_is_refused_in_words(
    wrapper: ModuleType, options: dict, message: str
) -> None:
    with pytest.raises(UserError, match=message):
        wrapper.BenchmarkEnvBuilder(**options)


def test_episodes_of_the_user_come_from_a_folder(wrapper: ModuleType, tmp_path: Path) -> None:
    records = [
        {"task": "StopCube", "episode": i, "seed": 900 + i, "difficulty": "hard"} for i in (1, 0)
    ]
    (tmp_path / "record_dataset_StopCube_metadata.json").write_text(
        json.dumps({"records": records})
    )
    builder = wrapper.BenchmarkEnvBuilder("StopCube", override_metadata_path=tmp_path)
    assert builder.get_episode_num() == 2
    assert builder.resolve_episode(1) == (901, "hard")


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ('"x"', "is not official metadata"),
        ('{"episode": 0}', "is not official metadata"),
        ('{"episode": 0, "seed": 1e3, "difficulty": "easy"}', "is not official metadata"),
        ('{"episode": 1, "seed": 1, "difficulty": "easy"}', "does not number its episodes"),
    ],
)
def test_metadata_of_another_form_is_refused(
    wrapper: ModuleType, tmp_path: Path, record: str, message: str
) -> None:
    file = tmp_path / "record_dataset_StopCube_metadata.json"
    file.write_text(f'{{"records": [{record}]}}')
    with pytest.raises(UserError, match=message):
        wrapper.BenchmarkEnvBuilder("StopCube", override_metadata_path=tmp_path)


def test_its_environment_is_make_envs(wrapper: ModuleType) -> None:
    importlib.import_module("robomme.robomme_env")
    builder = wrapper.BenchmarkEnvBuilder("StopCube", dataset="val", max_steps=5)
    benchmark_env = builder.make_env_for_episode(3, include_front_depth=True)
    include = Include(front_depth=True)
    local_env = make_env("StopCube", "val", 3, max_steps=5, include=include)
    try:
        assert (
            benchmark_env.unwrapped.difficulty == metadata.episode("StopCube", "val", 3).difficulty
        )
        observation, info = benchmark_env.reset()
        expected, info_ = local_env.reset()
        assert info["task_goal"] == info_["task_goal"]
        assert set(observation) == set(expected) and "front_depth_list" in observation
        for key, values in expected.items():
            np.testing.assert_array_equal(np.stack(observation[key]), np.stack(values), err_msg=key)
        action = np.array([*observation["joint_state_list"][-1][:7], 1.0], np.float32)
        after_step, *_ = benchmark_env.step(action + 0.01)
        np.testing.assert_array_equal(
            after_step["front_rgb_list"][-1], local_env.step(action + 0.01)[0]["front_rgb_list"][-1]
        )
        statuses = [benchmark_env.step(action)[4]["status"] for _ in range(8)]
        assert statuses[0] == "ongoing" and statuses[-1] == "timeout"
    finally:
        benchmark_env.close()
        local_env.close()
