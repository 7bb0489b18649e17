"""plugins/lerobot_policy_mme_vla in one process: the numbers are those of the policy itself, and
folders come back.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from helpers.plugins import plugin
from mme_vla import Policy
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.embodiment.robomme import benchmark_state
from mme_vla.errors import UserError
from mme_vla.testing.small import small_policy

gym = pytest.importorskip(
    "gymnasium", reason="LeRobot's environments: uv sync --inexact --extra sim"
)
VIDEOS = {0: 21, 1: 3}
"""Frames of the conditioning video, by episode."""
MODEL, STEPS = "tokendrop_expert", 26


class MediaPart:
    """The benchmark's interface: a square that stands where the first joint is, over noise of the
    episode's own.
    """

    def __init__(self, episode: int) -> None:
        self.episode, self.joints, self.count = episode, np.zeros(8, np.float32), 0

    def reset(self) -> tuple[dict[str, Any], dict[str, Any]]:
        self.rng, self.joints, self.count = (
            np.random.default_rng(self.episode),
            np.zeros(8, np.float32),
            0,
        )
        return self._lists(VIDEOS[self.episode] + 1), {
            "task_goal": [f"touch square {self.episode}"]
        }

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.joints, self.count = np.asarray(action, np.float32), self.count + 1
        return self._lists(1), 0.0, False, self.count >= STEPS, {"status": "ongoing"}

    def close(self) -> None:
        """Nothing to free."""

    def _lists(self, count: int) -> dict[str, Any]:
        images = self.rng.integers(0, 200, (2, count, 256, 256, 3), np.uint8)
        at = int(abs(self.joints[0]) * 50) % 200
        images[:, :, at : at + 40, 60:100] = 255
        return {
            "front_rgb_list": list(images[0]),
            "wrist_rgb_list": list(images[1]),
            "joint_state_list": [self.joints[:7]] * count,
            "gripper_state_list": [self.joints[6:]] * count,
        }


@pytest.fixture(scope="module")
def package() -> Iterator[ModuleType]:
    with plugin("lerobot_policy_mme_vla", "lerobot_policy_mme_vla", keep=True) as package:
        import lerobot_policy_mme_vla.convert
        import lerobot_policy_mme_vla.env_mme_vla  # noqa: F401

        yield package


@pytest.fixture(scope="module")
def our_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ours") / "policy"
    small_policy(MODEL).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def lerobot_folder(package: ModuleType, our_folder: Path) -> Path:
    """The same policy as LeRobot's commands know it."""
    folder = our_folder.parent / "theirs"
    package.convert.main([str(our_folder), str(folder)])
    return folder


def in_process(folder: Path) -> np.ndarray:
    """Actions [2, STEPS, 8] of both episodes, acting together as the library's own loop does."""
    policy, envs = Policy.from_pretrained(folder), [MediaPart(0), MediaPart(1)]
    observed = [env.reset() for env in envs]
    episodes = [policy.start_episode(info["task_goal"][0], seed=42) for _, info in observed]
    waiting = [lists for lists, _ in observed]
    done: list[np.ndarray] = []
    while len(done) < STEPS:
        for episode, lists in zip(episodes, waiting, strict=True):
            count = len(lists["front_rgb_list"])
            states = np.stack(
                list(map(benchmark_state, lists["joint_state_list"], lists["gripper_state_list"]))
            )
            frames = {name: np.stack(lists[f"{name}_rgb_list"]) for name in ("front", "wrist")}
            first = episode.n_observed_frames == 0
            episode.observe(frames, states, np.arange(count) < count - 1 if first else False)
        # Their videos differ in length, so LeRobot's loop reads them one after the other, and so
        # does this.
        chunks = np.stack([policy.act(episode) for episode in episodes])[
            :, : min(16, STEPS - len(done))
        ]
        taken = [
            [env.step(action)[0] for action in chunk]
            for env, chunk in zip(envs, chunks, strict=True)
        ]
        waiting = [{key: [step[key][0] for step in steps] for key in steps[0]} for steps in taken]
        done += list(chunks.transpose(1, 0, 2))
    return np.stack(done, 1)


def through_lerobot(
    package: ModuleType, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> np.ndarray:
    """The same through its factory, pipelines and vectorised environments."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import preprocess_observation
    from lerobot.policies import make_policy, make_pre_post_processors

    monkeypatch.setattr(
        package.env_mme_vla, "make_env", lambda task, split, episode, max_steps: MediaPart(episode)
    )
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    settings = package.MMEVLAEnvConfig(task="VideoUnmask", max_steps=STEPS)
    policy = make_policy(config, env_cfg=settings)
    before, after = make_pre_post_processors(config, pretrained_path=str(folder))
    envs = settings.create_envs(2)["VideoUnmask"][0]
    observation, _ = envs.reset(seed=[1, 2], options={"lerobot_new_rollout": True})
    received: list[list[np.ndarray]] = [[], []]
    while min(map(len, received)) < STEPS:
        batch = preprocess_observation(observation) | {"task": list(envs.call("task_description"))}
        playing = observation["is_demo"][:, 0] > 0
        with torch.inference_mode():
            action = after(policy.select_action(before(batch))).numpy()
        for i in range(2):
            if not playing[i]:
                received[i].append(action[i])
        observation, *_ = envs.step(action)
    return np.stack([np.stack(actions[:STEPS]) for actions in received])


def test_actions_are_those_of_the_policy_in_process(
    package: ModuleType, our_folder: Path, lerobot_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = in_process(our_folder)
    actions = through_lerobot(package, lerobot_folder, monkeypatch)
    assert np.abs(expected[0] - expected[1]).max() > 1e-3  # the episodes do differ
    np.testing.assert_array_equal(actions, expected)


def test_a_robot_comes_from_a_folder_of_yaml_files(package: ModuleType, tmp_path: Path) -> None:
    from lerobot.configs import FeatureType, PolicyFeature

    (tmp_path / "embodiment").mkdir()
    (tmp_path / "embodiment/arm.yaml").write_text(
        "name: arm\ncameras: {head: {augment: none}}\nmemory_camera: head\n"
        "state: {width: 2}\naction: {width: 2, horizon: 4, execute: 4}\n"
    )
    features = {
        "input_features": {
            "observation.images.head": PolicyFeature(FeatureType.VISUAL, (3, 24, 32)),
            "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
        },
        "output_features": {"action": PolicyFeature(FeatureType.ACTION, (2,))},
        "device": "cpu",
    }
    with pytest.raises(UserError, match=r"--policy\.config_dir=.*--rename_map="):
        package.modeling_mme_vla.MMEVLAPolicy(package.MMEVLAConfig(**features))
    config = package.MMEVLAConfig(
        **features, config_dir=str(tmp_path), overrides=["embodiment=arm", "backbone=tiny"]
    )
    assert package.modeling_mme_vla.MMEVLAPolicy(config).model.embodiment.name == "arm"


def test_a_checkpoint_goes_there_and_back(
    package: ModuleType, our_folder: Path, lerobot_folder: Path, tmp_path: Path
) -> None:
    assert {
        "policy_preprocessor.json",
        "policy_postprocessor.json",
        "processor.json",
        "norm_stats.json",
    } <= {file.name for file in lerobot_folder.iterdir()}
    package.convert.main([str(lerobot_folder), str(tmp_path / "back")])
    first, second = Policy.from_pretrained(our_folder), Policy.from_pretrained(tmp_path / "back")
    assert first.config == second.config
    for name, tensor in first.state_dict().items():
        assert torch.equal(tensor, second.state_dict()[name]), name
    with pytest.raises(SystemExit):
        package.convert.main([str(lerobot_folder), str(our_folder)])


def test_an_earlier_folder_whose_sums_lack_the_configuration_is_converted(
    package: ModuleType, lerobot_folder: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(lerobot_folder, tmp_path / "earlier"))
    lines = (folder / "SHA256SUMS").read_text().splitlines(keepends=True)
    (folder / "SHA256SUMS").write_text(
        "".join(line for line in lines if not line.endswith("  config.json\n"))
    )
    package.convert.main([str(folder), str(tmp_path / "back")])
    assert (tmp_path / "back" / "model.safetensors").is_file()


def test_damage_and_strange_code_are_refused(
    package: ModuleType, lerobot_folder: Path, tmp_path: Path
) -> None:
    from lerobot_policy_mme_vla.modeling_mme_vla import MMEVLAPolicy

    config = json.loads((lerobot_folder / "config.json").read_text())
    sections = json.loads(config["composition"])
    for file in lerobot_folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "config.json").write_text(
        json.dumps(config | {"composition": json.dumps(sections | {"plugins": ["somebodys_code"]})})
    )
    with pytest.raises(UserError, match=r"config\.json is damaged"):
        MMEVLAPolicy.from_pretrained(tmp_path)
    (tmp_path / "SHA256SUMS").rename(tmp_path / "sums")
    with pytest.raises(UserError, match="needs the plugin somebodys_code"):
        MMEVLAPolicy.from_pretrained(tmp_path)
    (tmp_path / "sums").rename(tmp_path / "SHA256SUMS")
    shutil.copy(lerobot_folder / "config.json", tmp_path)
    weights = bytearray((tmp_path / "model.safetensors").read_bytes())
    weights[-3] ^= 1
    (tmp_path / "model.safetensors").write_bytes(weights)
    with pytest.raises(UserError, match=r"model.safetensors is damaged"):
        MMEVLAPolicy.from_pretrained(tmp_path)


def test_a_chunk_matches_the_one_under_way(package: ModuleType, lerobot_folder: Path) -> None:
    from lerobot_policy_mme_vla.modeling_mme_vla import MMEVLAPolicy

    policy = MMEVLAPolicy.from_pretrained(lerobot_folder)
    assert policy.supports_rtc()
    views = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    names = ("observation.images.image", "observation.images.wrist_image")
    batch = {
        **dict.fromkeys(names, views),
        "observation.state": torch.zeros(1, 8),
        "task": ["touch it"],
    }
    left = torch.linspace(0.2, 0.4, 8 * 6).reshape(6, 8)
    policy.reset()
    free = policy.predict_action_chunk(batch)
    policy.reset()
    filled = torch.cat([left, torch.zeros(4, 8)])  # as LeRobot hands it over
    bound = policy.predict_action_chunk(batch, inference_delay=4, prev_chunk_left_over=filled)
    apart = [(chunk[0, :4] - left[:4]).abs().mean() for chunk in (free, bound)]
    assert apart[1] < 0.15 * apart[0]
    policy.reset()
    exact = policy.predict_action_chunk(batch, inference_delay=4, prev_chunk_left_over=left)
    assert torch.equal(bound, exact)


def test_statistics_and_steps_are_of_the_episodes_that_lerobot_trains_on(
    package: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from lerobot.datasets import LeRobotDataset
    from lerobot_policy_mme_vla.samples import Samples

    part = LeRobotDataset("local/sample", root=SAMPLE, episodes=[1, 3])
    full = LeRobotDataset("local/sample", root=SAMPLE)
    config = package.MMEVLAConfig(model="pi05", cache_root=str(tmp_path))
    printed, stats = [], []
    for dataset in (full, part):
        model = small_policy("pi05")
        model.require_processor().stats = None
        samples = Samples(model, config, dataset.meta)
        rows = [dataset[0]["index"], torch.tensor(900)]  # the second is of episode 3
        assert len(samples.batch(torch.stack(rows)).actions) == 2
        stats.append(model.require_processor().require_stats().state)
        printed.append(capsys.readouterr().out)
    assert "in 4 episodes, 0 held-out steps in 0" in printed[0]
    assert "in 2 episodes" in printed[1] and "held-out steps in 2" in printed[1]
    assert not np.array_equal(stats[0].mean, stats[1].mean)
    # `eval_split` computes the loss of held-out episodes too
    assert len(samples.batch(torch.tensor([100])).actions) == 1


def test_an_episode_that_ends_in_an_error_says_why(package: ModuleType) -> None:
    class Failing:
        def step(
            self, action: np.ndarray
        ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
            info = {
                "status": "error",
                "error_message": "no way to this pose",
                "exception_type": "PlanningError",
            }
            return {}, 0.0, True, False, info

    env = package.env_mme_vla.RoboMMEWithVideo("StopCube", "test", 0, 10)
    env._env = Failing()
    *_, over, _, info = env.step(np.zeros(8))
    assert over and (info["error_message"], info["exception_type"]) == (
        "no way to this pose",
        "PlanningError",
    )
