"""LeRobot's own commands with plugins/lerobot_policy_mme_vla installed: train, go on, evaluate with the video."""

import json
from pathlib import Path

import pytest
from h5_files import write_file
from lerobot_commands import EVAL, TRAIN, run_commands

from mme_vla.data.conversion import ConvertOptions, convert
from mme_vla.data.hdf5 import find_files, list_episodes

pytest.importorskip("mani_skill", reason="lerobot-eval runs the simulator: uv sync --inexact --extra sim")


def test_a_policy_is_trained_resumed_and_evaluated_with_the_conditioning_video(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_VideoUnmask.h5", [12, 9], videos=[4, 3], size=64)
    data, run, judged = tmp_path / "data", tmp_path / "run", tmp_path / "judged"
    convert(list_episodes(find_files([tmp_path])), data, ConvertOptions(images="png", names="lerobot"))
    trained = run / "checkpoints/last/pretrained_model"
    said = run_commands(
        tmp_path,
        [
            [TRAIN, "--policy.type=mme_vla", "--policy.model=tokendrop_expert", "--policy.device=cpu",
             f"--policy.cache_root={tmp_path / 'cache'}", "--policy.push_to_hub=false", "--dataset.repo_id=local/data",
             f"--dataset.root={data}", f"--output_dir={run}", "--steps=3", "--batch_size=4", "--num_workers=0",
             "--log_freq=1", "--env_eval_freq=0", "--save_freq=3"],
            [TRAIN, f"--config_path={trained / 'train_config.json'}", "--resume=true", "--steps=4"],
            [EVAL, f"--policy.path={trained}", "--policy.device=cpu", "--env.type=mme_vla", "--env.task=VideoUnmask",
             "--env.max_steps=2", "--eval.batch_size=1", "--eval.n_episodes=1", f"--output_dir={judged}"],
        ],
        plugins={"lerobot_policy_mme_vla": "lerobot_policy_mme_vla"},
    )  # fmt: skip
    losses = [float(part.split()[0]) for part in said.split(" loss:")[1:]]
    assert len(losses) == 4 and all(0.1 < loss < 20 for loss in losses), said[-3000:]
    info = json.loads((judged / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 1 and info["overall"]["pc_success"] == 0.0
    film = next(judged.glob("videos/**/*.mp4"))
    assert frames_of(film) > 60  # the video of 66 frames is in it
    assert {"policy_preprocessor.json", "norm_stats.json", "processor.json"} <= {f.name for f in trained.iterdir()}


def frames_of(film: Path) -> int:
    import av

    with av.open(str(film)) as opened:
        return sum(1 for _ in opened.decode(video=0))
