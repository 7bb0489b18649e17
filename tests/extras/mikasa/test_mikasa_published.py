"""The published LeRobot datasets of MIKASA-Robo-VLA: a small one in their layout, made here, is
read and trained on as it is.
"""

import logging
from pathlib import Path

import numpy as np
import pytest

from helpers import commands
from mme_vla.cli.inspect import main as inspect
from mme_vla.config.composition import compose
from mme_vla.data.episodes import EpisodeSource
from mme_vla.embodiment import Embodiment
from mme_vla.envs.base import environment

GOAL = "Touch the cube of the color that was shown."
LENGTHS = (12, 9)
SIDE = 128
SMALL = (
    "backbone.depth=1",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=16",
    "backbone.vision.patch_size=1",
    "backbone.vision.width=16",
    "backbone.vision.mlp_dim=16",
    "memory.budget=64",
    "train.steps=2",
    "train.batch_size=2",
    "train.val_samples=0",
    "train.open_loop_chunks=0",
    "train.workers=0",
    "train.device=cpu",
    "logger=none",
)


def pattern(episode: int, frame: int) -> np.ndarray:
    """An image whose brightness tells episode and frame, and survives a lossy video."""
    return np.full((SIDE, SIDE, 3), 20 + 100 * episode + 5 * frame, np.uint8)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One task's folder: AV1 videos at 10 frames a second, and vectors whose numbers have no
    names.
    """
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    view = {"dtype": "video", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channel"]}
    vector = {"dtype": "float32", "shape": (7,), "names": None}
    root = tmp_path_factory.mktemp("mikasa") / "remember_color_3_vla_v0"
    dataset = LeRobotDataset.create(
        "local/remember_color_3_vla_v0",
        10,
        {
            "observation.images.top": view,
            "observation.state": vector,
            "action": vector,
            "observation.images.wrist": view,
        },
        root=root,
        robot_type="mikasa_robo",
        video_backend="pyav",
        rgb_encoder=RGBEncoderConfig(vcodec="libsvtav1", crf=30, pix_fmt="yuv420p"),
    )
    for episode, length in enumerate(LENGTHS):
        for frame in range(length):
            dataset.add_frame(
                {
                    "observation.images.top": pattern(episode, frame),
                    "observation.images.wrist": 255 - pattern(episode, frame),
                    "observation.state": np.full(7, frame, np.float32),
                    "action": np.full(7, frame / 100, np.float32),
                    "task": GOAL,
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def test_a_published_dataset_is_read_as_it_is(
    published: Path, caplog: pytest.LogCaptureFixture
) -> None:
    robot = Embodiment.from_dict(environment("mikasa").embodiment)
    with caplog.at_level(logging.WARNING):
        source = EpisodeSource(published, robot=robot)
    assert not caplog.records
    assert source.fps == 10 and source.lengths.tolist() == list(LENGTHS)
    assert source.exec_starts.tolist() == [0, 0]
    assert source.goal(1) == GOAL.lower()
    assert set(source.lossy) == {"top", "wrist"}
    np.testing.assert_allclose(source.states(1, 3, 5)[:, 0], [3, 4])
    np.testing.assert_allclose(source.actions(1, 3, 5)[:, 6], [0.03, 0.04])
    for camera in ("top", "wrist"):
        brightness = source.frames(1, [2, 7], camera).mean(axis=(1, 2, 3))
        expected = np.array([pattern(1, frame).mean() for frame in (2, 7)])
        if camera == "wrist":
            expected = 255 - expected
        np.testing.assert_allclose(brightness, expected, atol=4)


def test_inspect_shows_it_as_of_the_robot_of_its_environment(
    published: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inspect(compose("inspect", ["env=mikasa", f"dataset={published}"]))
    printed = capsys.readouterr().out
    assert f"{sum(LENGTHS)} execution steps to train on · 10 frames per second" in printed
    assert "7 numbers: x, y, z, roll, pitch, yaw, gripper" in printed and "draft" not in printed


def test_a_policy_trains_on_a_published_dataset(published: Path, tmp_path: Path) -> None:
    words = ("env=mikasa", f"data.sources=[{published}]", "model=framesamp_modul", *SMALL)
    cache = {"MME_VLA_CACHE": str(tmp_path / "caches"), "OMP_NUM_THREADS": "1"}
    done = commands.run("mme_vla", "train", *words, "output=run", cwd=tmp_path, env=cache)
    assert done.returncode == 0, done.stderr[-3000:]
    assert (tmp_path / "run" / "checkpoints" / "step_000002").is_dir()
