"""docs/extend/your-robot.md, run as it stands on a generated dataset: two arms, 14 numbers, three
cameras, no video.
"""

import io
import json
import re
import shlex
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from helpers import REPOSITORY
from helpers.rollout_fakes import InlineEnvs, roll
from helpers.scripted_env import ScriptedEnv, make_scripted_env
from helpers.serving_fakes import Served
from helpers.tried_env import SMALL
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.cli.cache import main as cache_main
from mme_vla.cli.inspect import main as inspect_main
from mme_vla.cli.train import train
from mme_vla.config.composition import compose
from mme_vla.data.cache import cache_folder, fingerprint
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.frame_tables import open_table
from mme_vla.data.lerobot_files import read_info
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.envs.vector.pool import Job
from mme_vla.memory.history import StorageSpec
from mme_vla.testing.small import SMALL_VISION, unit_stats
from mme_vla.training.settings import TrainRun

EXAMPLE = REPOSITORY / "examples" / "bimanual"
PAGE = (REPOSITORY / "docs" / "extend" / "your-robot.md").read_text()
CAMERAS = ("top", "left_wrist", "right_wrist")
BRIEF = [
    "train.steps=2",
    "train.batch_size=2",
    "train.val_samples=0",
    "train.open_loop_chunks=1",
    "train.workers=0",
    "train.device=cpu",
    "logger=none",
]


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)


def write_dataset(root: Path) -> None:
    """Two arms that move, as LeRobot's own recorder would store them."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    names = [f"{side}_{i}" for side in ("left", "right") for i in range(7)]
    numbers = {"dtype": "float32", "shape": (14,), "names": names}
    view = {"dtype": "image", "shape": (24, 32, 3), "names": ["height", "width", "channels"]}
    views = {f"observation.images.{camera}": view for camera in CAMERAS}
    features = {**views, "observation.state": numbers, "action": numbers}
    dataset = LeRobotDataset.create(
        "local/bimanual", fps=10, features=features, root=root, use_videos=False
    )
    rng = np.random.default_rng(0)
    for length in (14, 11):
        for _ in range(length):
            images = {name: rng.integers(0, 255, (24, 32, 3), np.uint8) for name in views}
            state = rng.normal(size=14).astype(np.float32)
            dataset.add_frame(
                {
                    **images,
                    "observation.state": state,
                    "action": state + 0.1,
                    "task": "Fold the towel",
                }
            )
        dataset.save_episode()
    dataset.finalize()


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the page's `configs` and `demonstrations`, as the current one."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "configs").symlink_to(EXAMPLE / "configs")
    write_dataset(folder / "demonstrations")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("MME_VLA_CACHE", str(folder / "caches"))
        yield folder


class Robot:
    """A fake of the reader's robot: its images are noise, and it keeps the commands."""

    def __init__(self) -> None:
        self.executed: list[np.ndarray] = []

    def new_observations(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        count = 1 + len(self.executed) * 8
        frames = np.random.default_rng(count).integers(0, 255, (count, 24, 32, 3), np.uint8)
        return dict.fromkeys(CAMERAS, frames), np.zeros((count, 14), np.float32)

    def execute(self, actions: np.ndarray) -> None:
        assert actions.shape == (8, 14) and np.isfinite(actions).all()
        self.executed.append(actions)


@pytest.mark.slow
def test_images_are_copied_once_with_one_line_and_no_bar(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("MME_VLA_CACHE", str(tmp_path))
    root = place / "demonstrations"
    features = read_info(root).features
    columns = [name for name in features if name.startswith("observation.images.")]
    printed = []
    for _ in range(2):
        terminal = Terminal()
        monkeypatch.setattr("sys.stderr", terminal)
        assert open_table(root, columns, features).num_rows == 25
        printed.append(terminal.getvalue())
    assert re.fullmatch(r".*demonstrations: copying the images once to .* …\n", printed[0])
    assert printed[1] == ""


def test_the_page_shows_the_file_that_is_tested() -> None:
    assert blocks("yaml") == [(EXAMPLE / "configs" / "embodiment" / "two_arms.yaml").read_text()]


@pytest.mark.slow
def test_the_page_from_the_dataset_to_a_served_policy(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inspecting, cached, training = (shlex.split(line) for line in blocks("bash")[0].splitlines())
    assert inspecting[:4] == ["mme-vla", "inspect", "--config-dir", "configs"]
    assert cached[:4] == ["mme-vla", "cache", "--config-dir", "configs"]
    assert training[:4] == ["mme-vla", "train", "--config-dir", "configs"]
    folders = [place / "configs"]
    inspect_main(compose("inspect", inspecting[4:], extra_dirs=folders))
    inspected = capsys.readouterr().out
    assert "25" in inspected, "frames of both episodes"
    assert "left_0" in inspected and "number 1" not in inspected
    cache_main(compose("cache", [*cached[4:], *SMALL, "device=cpu"], extra_dirs=folders))
    assert "2 episodes encoded" in capsys.readouterr().out
    cfg = compose("train", [*training[4:], *SMALL, *BRIEF], extra_dirs=folders)
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    run = TrainRun.from_config(config)
    checkpoint = train(run, Path(run.output), begun=time.perf_counter())
    assert "runs/two_arms" in str(checkpoint)
    summary = json.loads((checkpoint.parents[1] / "summary.json").read_text())
    assert summary["open_loop"]["names"][0] == "left_0"

    checking = shlex.split(blocks("bash")[1])
    assert checking[:2] == ["mme-vla", "inspect"]
    capsys.readouterr()
    inspect_main(compose("inspect", checking[2:]))
    checked = capsys.readouterr().out
    assert "episode 1 of demonstrations" in checked and "right_6" in checked
    assert "baseline" in checked.splitlines()[-3]

    acting, asking = blocks("python")
    robot = Robot()
    names: dict[str, Any] = {"robot": robot, "chunks": 3}
    exec(acting.replace("runs/two_arms/checkpoints/step_000350", str(checkpoint)), names)
    policy: MMEPolicy = names["policy"]
    assert len(robot.executed) == 3 and names["actions"].shape == (10, 14)
    assert names["episode"].n_observed_frames == 1 + 9 + 17 and len(names["episode"].history) == 27
    assert policy.embodiment.memory_camera == "top" and policy.embodiment.camera_names == CAMERAS

    robot = Robot()
    with Served(policy, seed=0, flow_steps=10) as served:
        assert (
            served.server.metadata["cameras"] == list(CAMERAS)
            and served.server.metadata["action_dim"] == 14
        )
        exec(
            asking.replace("ws://127.0.0.1:8001", f"ws://127.0.0.1:{served.server.port}"),
            {"robot": robot},
        )
        with served.client() as client, pytest.raises(UserError, match="observation/left_wrist"):
            image = np.zeros((24, 32, 3), np.uint8)
            client.infer(
                {"observation/top": image, "observation/state": np.zeros(14), "prompt": "fold"}
            )
    alone = policy.start_episode("fold the towel", seed=0)
    alone.observe(*Robot().new_observations())
    assert np.allclose(robot.executed[0], policy.act([alone])[0][:8], atol=1e-5)


def test_columns_are_detected_in_both_spellings_joined_or_by_name(place: Path) -> None:
    section = OmegaConf.to_container(
        OmegaConf.load(EXAMPLE / "configs" / "embodiment" / "two_arms.yaml")
    )
    assert isinstance(section, dict)
    robot = Embodiment.from_dict({str(key): value for key, value in section.items()})
    source = EpisodeSource("demonstrations", robot=robot)
    assert source.exec_starts.tolist() == [0, 0] and source.goal(1) == "fold the towel"
    assert source.columns["top"] == "observation.images.top" and source.frames(
        1, [3, 10]
    ).shape == (2, 24, 32, 3)
    twice = {
        "state": {"key": ["state", "action"], "width": 28},
        "action": {"key": "actions", "width": 14},
    }
    joined = EpisodeSource(
        "demonstrations", robot=Embodiment.from_dict({**robot.to_dict(), **twice})
    )
    assert np.array_equal(
        joined.states(0), np.concatenate([source.states(0), source.actions(0)], axis=1)
    )
    with pytest.raises(UserError, match=r"action has shape \[14\]; expected \[7\]"):
        EpisodeSource(
            "demonstrations",
            robot=Embodiment.from_dict({**robot.to_dict(), "action": {"width": 7}}),
        )
    with pytest.raises(
        UserError,
        match=r"lacks the features image, wrist_image.*take a dataset of this.*choose embodiment=",
    ):
        EpisodeSource("demonstrations")
    shortened = {"cameras": {"eye": {"key": "images.left_wrst"}}, "memory_camera": "eye"}
    with pytest.raises(
        UserError, match=r"Did you mean `key: (.*)left_wrist` for images\.left_wrst"
    ):
        EpisodeSource(
            "demonstrations", robot=Embodiment.from_dict({**robot.to_dict(), **shortened})
        )
    hand = EpisodeSource(
        "demonstrations",
        robot=Embodiment.from_dict({**robot.to_dict(), "memory_camera": "left_wrist"}),
    )
    places = [
        cache_folder(place, s, fingerprint(s, StorageSpec(4), "encoder")) for s in (source, hand)
    ]
    assert places[0] != places[1], "tokens of two cameras lie beside each other"
    video = Embodiment.from_dict({**robot.to_dict(), "conditioning_video": True})
    with pytest.raises(UserError, match="does not mark its conditioning videos"):
        EpisodeSource("demonstrations", robot=video)


def test_a_third_camera_is_visible_in_rollouts_and_another_can_feed_memory(tmp_path: Path) -> None:
    (tmp_path / "embodiment").mkdir()
    yaml = (
        "defaults: [robomme_joint, _self_]\nname: watched\ncameras: {side: {}}\nmemory_camera:"
        " side\n"
    )
    (tmp_path / "embodiment" / "watched.yaml").write_text(yaml)
    backbone = {"vision": SMALL_VISION}
    policy = build_policy(
        "framesamp_modul",
        config_dir=tmp_path,
        embodiment="watched",
        backbone=backbone,
        memory={"budget": 64},
    )
    robot = policy.embodiment
    assert robot.camera_names == ("front", "wrist", "side") and robot.action == ROBOMME_JOINT.action
    policy.require_processor().stats = unit_stats(robot)
    encoded: list[np.ndarray] = []
    encode = policy.encode_frames
    policy.encode_frames = lambda frames, *arguments: (
        encoded.append(frames),
        encode(frames, *arguments),
    )[1]  # type: ignore
    job = Job("PickXtimes", "test", 0)
    with pytest.raises(UserError, match="The environment has no camera 'side'"):
        roll(policy, [job], InlineEnvs(robot=robot))
    (record,) = roll(policy, [job], InlineEnvs(robot=robot, base=make_watched_env, max_steps=20))
    assert record.outcome == "timeout" and record.steps == 21
    assert encoded and all((frames == 77).all() for frames in encoded), (
        "memory is fed by the third camera alone"
    )


def make_watched_env(**options: Any) -> ScriptedEnv:
    """The scripted environment with one more camera."""
    env = make_scripted_env(**options)
    lists = env._lists

    def watched(frames: list[dict[str, Any]]) -> dict[str, Any]:
        side = [np.full((64, 64, 3), 77, np.uint8) for _ in frames]
        return {**lists(frames), "side_rgb_list": side}

    env._lists = watched  # type: ignore[method-assign]
    return env


def test_the_papers_real_robot_is_one_word() -> None:
    cfg = compose("train", ["experiment=real_robot", "data.sources=[somewhere]"])
    assert (cfg.memory.budget, cfg.train.steps, cfg.train.batch_size, float(cfg.train.lr)) == (
        2048,
        50000,
        64,
        5e-5,
    )
    section: Any = OmegaConf.to_container(cfg.embodiment, resolve=True)
    robot = Embodiment.from_dict(section)
    assert robot.memory_camera == "right_shoulder" and len(robot.cameras) == 3 and robot.fps == 15
    baseline = compose(
        "train",
        ["experiment=real_robot", "model=pi05", "~memory.budget", "data.sources=[somewhere]"],
    )
    assert not baseline.memory and baseline.name == "pi05"
