"""LeRobot's own commands with plugins/lerobot_policy_mme_vla installed, and its ACT on a dataset of
this library.
"""

import json
import os
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest

from helpers import REPOSITORY
from helpers.h5_files import write_file
from helpers.plugins import PLUGINS
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import find_files, list_episodes

pytest.importorskip(
    "mani_skill", reason="lerobot-eval runs the simulator: uv sync --inexact --extra sim"
)

pytestmark = pytest.mark.nightly

TRAIN, EVAL, VIZ = (f"lerobot.scripts.lerobot_{name}" for name in ("train", "eval", "dataset_viz"))
SMALL_ACT = (
    "--policy.type=act",
    "--policy.device=cpu",
    "--policy.push_to_hub=false",
    "--policy.chunk_size=4",
    "--policy.n_action_steps=4",
    "--policy.pretrained_backbone_weights=null",
    "--policy.dim_model=32",
    "--policy.n_heads=2",
    "--policy.dim_feedforward=32",
    "--policy.n_encoder_layers=1",
    "--policy.latent_dim=4",
    "--policy.n_vae_encoder_layers=1",
)


def run_lerobot(folder: Path, commands: Sequence[Sequence[str]], plugin: str) -> str:
    """The output of commands in fresh processes, offline, with a package of plugins/ as if
    installed.
    """
    project = tomllib.loads((PLUGINS / plugin / "pyproject.toml").read_text())["project"]
    name = project["name"]  # LeRobot finds plugins by it
    metadata = folder / "site" / f"{name.replace('-', '_')}-0.1.0.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
    paths = [REPOSITORY, REPOSITORY / "tests", PLUGINS / plugin / "src", metadata.parent]
    variables = {
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(folder / "hf"),
    }
    printed = ""
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-m", *command],
            env={**os.environ, **variables, "ACCELERATE_USE_CPU": "true"},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        assert done.returncode == 0, done.stdout[-6000:]
        printed += done.stdout
    return printed


def test_a_policy_is_trained_and_evaluated_with_the_conditioning_video(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_VideoUnmask.h5", [12, 9], videos=[4, 3], size=64)
    data, run, judged = tmp_path / "data", tmp_path / "run", tmp_path / "judged"
    convert(
        list_episodes(find_files([tmp_path])), data, ConvertOptions(images="png", names="lerobot")
    )
    trained = run / "checkpoints/last/pretrained_model"
    output = run_lerobot(
        tmp_path,
        [
            [
                TRAIN,
                "--policy.type=mme_vla",
                "--policy.model=tokendrop_expert",
                "--policy.device=cpu",
                f"--policy.cache_root={tmp_path / 'cache'}",
                "--policy.push_to_hub=false",
                "--dataset.repo_id=local/data",
                f"--dataset.root={data}",
                f"--output_dir={run}",
                "--steps=3",
                "--batch_size=4",
                "--num_workers=0",
                "--log_freq=1",
                "--env_eval_freq=0",
                "--save_freq=3",
            ],
            [
                EVAL,
                f"--policy.path={trained}",
                "--policy.device=cpu",
                "--env.type=mme_vla",
                "--env.task=VideoUnmask",
                "--env.max_steps=2",
                "--eval.batch_size=1",
                "--eval.n_episodes=1",
                f"--output_dir={judged}",
            ],
        ],
        plugin="lerobot_policy_mme_vla",
    )
    losses = [float(part.split()[0]) for part in output.split(" loss:")[1:]]
    assert len(losses) == 3 and all(0.1 < loss < 20 for loss in losses), output[-3000:]
    info = json.loads((judged / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 1 and info["overall"]["pc_success"] == 0.0
    video = next(judged.glob("videos/**/*.mp4"))
    assert frames_of(video) > 60  # the video of 66 frames is in it
    assert {"policy_preprocessor.json", "norm_stats.json", "processor.json"} <= {
        f.name for f in trained.iterdir()
    }


def test_a_resumed_run_equals_an_uninterrupted_one_but_for_one_random_number_that_lerobot_draws(
    tmp_path: Path,
) -> None:
    """The resumed run gets the random state of its checkpoint back: LeRobot 0.6.1 has drawn one
    number from it.
    """
    write_file(tmp_path / "record_dataset_PickXtimes.h5", [9, 7], size=64)
    data, run = tmp_path / "data", tmp_path / "run"
    convert(
        list_episodes(find_files([tmp_path])), data, ConvertOptions(images="png", names="lerobot")
    )
    last = run / "checkpoints/000004/pretrained_model/model.safetensors"
    policy = [
        "--policy.type=mme_vla",
        "--policy.model=tokendrop_expert",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        f"--policy.cache_root={tmp_path / 'cache'}",
    ]
    resume = (
        f"--config_path={run / 'checkpoints/000002/pretrained_model/train_config.json'}",
        "--resume=true",
    )
    runs = {
        "uninterrupted": [
            TRAIN,
            *policy,
            "--dataset.repo_id=local/data",
            f"--dataset.root={data}",
            f"--output_dir={run}",
            "--steps=4",
            "--save_freq=2",
            "--batch_size=4",
            "--num_workers=0",
            "--log_freq=1",
            "--env_eval_freq=0",
        ],
        "resumed": ["helpers.lerobot_resume", *resume],
    }
    losses, weights = {}, {}
    for name, words in runs.items():
        message = run_lerobot(tmp_path / name, [words], plugin="lerobot_policy_mme_vla")
        losses[name] = [part.split()[0] for part in message.split(" loss:")[1:]][-2:]
        weights[name] = last.read_bytes()
    assert (
        losses["resumed"] == losses["uninterrupted"]
        and weights["resumed"] == weights["uninterrupted"]
    )


def frames_of(video: Path) -> int:
    import av

    with av.open(str(video)) as opened:
        return sum(1 for _ in opened.decode(video=0))


@pytest.mark.filterwarnings("ignore:load_recording:DeprecationWarning")
def test_act_is_trained_and_evaluated_and_the_curves_are_rendered(tmp_path: Path) -> None:
    rerun = pytest.importorskip("rerun", reason="lerobot-dataset-viz needs the extra viz")
    write_file(tmp_path / "record_dataset_PickXtimes.h5", [9, 7], size=64)
    data, run = tmp_path / "data", tmp_path / "run"
    convert(list_episodes(find_files([tmp_path])), data, ConvertOptions(names="lerobot"))
    dataset = (
        "--dataset.repo_id=local/data",
        f"--dataset.root={data}",
        "--dataset.video_backend=pyav",
    )
    trained = run / "checkpoints/last/pretrained_model"
    output = run_lerobot(
        tmp_path,
        [
            [
                TRAIN,
                *dataset,
                *SMALL_ACT,
                f"--output_dir={run}",
                "--steps=3",
                "--batch_size=4",
                "--num_workers=0",
                "--log_freq=1",
                "--env_eval_freq=0",
                "--save_freq=3",
            ],
            [
                EVAL,
                f"--policy.path={trained}",
                "--policy.device=cpu",
                "--env.type=robomme",
                "--env.task=PickXtimes",
                "--env.episode_length=2",
                "--eval.batch_size=1",
                "--eval.n_episodes=1",
                f"--output_dir={tmp_path / 'e'}",
            ],
            [
                VIZ,
                "--repo-id=local/data",
                f"--root={data}",
                "--episode-index=0",
                "--save=1",
                f"--output-dir={tmp_path}",
                "--num-workers=0",
            ],
        ],
        plugin="robomme",
    )
    losses = [part.split()[0] for part in output.split(" loss:")[1:]]
    assert len(losses) == 3 and all(float(loss) > 0 for loss in losses), output[-3000:]
    judged = json.loads((tmp_path / "e/eval_info.json").read_text())
    assert judged["overall"]["n_episodes"] == 1 and judged["overall"]["pc_success"] == 0.0
    schema = str(rerun.recording.load_recording(tmp_path / "local_data_episode_0.rrd").schema())
    for entity in ("action", "state", "observation.images.image"):
        assert f"/{entity}:" in schema
