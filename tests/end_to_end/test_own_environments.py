"""examples/blink and examples/pick_cube: environments of the user's own in every command, in fresh
processes.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from helpers import REPOSITORY, commands
from mme_vla.cli.results import main as results
from mme_vla.config.plugins import import_plugins
from mme_vla.envs.base import environment
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.serving.client import Client
from mme_vla.utils import read_json

SMALL = (
    "backbone.depth=1",
    "memory.budget=64",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=16",
    "backbone.vision.patch_size=1",
    "backbone.vision.width=16",
    "backbone.vision.mlp_dim=16",
)
BRIEF = ("train.batch_size=2", "train.val_samples=0", "train.open_loop_chunks=0", "train.workers=0",
         "train.device=cpu", "logger=none")  # fmt: skip
BLINK = ("env=blink", "plugins=[blink]")


def environment_of(example: str) -> dict[str, str]:
    return {
        "PYTHONPATH": f"{REPOSITORY}:{REPOSITORY / 'examples' / example}",
        "OMP_NUM_THREADS": "1",
    }


def run(folder: Path, example: str, command: str, *words: str) -> str:
    """Output of a command that runs in `folder`, with the example's module on the path: without
    tracebacks and bars of other packages.
    """
    done = commands.run("mme_vla", command, *words, cwd=folder, env=environment_of(example))
    assert done.returncode == 0, done.stderr[-3000:]
    for noise in ("Traceback", "torchcodec", "it/s", "examples/s", "%|"):
        assert noise not in done.stdout + done.stderr, done.stderr[-3000:]
    return done.stdout


def test_the_example_is_the_one_on_the_page() -> None:
    text = (REPOSITORY / "examples" / "blink" / "blink.py").read_text()
    assert text.strip() in (REPOSITORY / "docs" / "extend" / "environments.md").read_text()


@pytest.mark.nightly
def test_an_environment_of_ones_own_works_in_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(tmp_path, "blink", "record", *BLINK, "tasks=all", "episodes=4", "output=data")
    assert read_json(tmp_path / "data" / "meta" / "info.json", "a dataset")["total_episodes"] == 4
    run(
        tmp_path,
        "blink",
        "train",
        *BLINK,
        "data.sources=[data]",
        "model=framesamp_modul",
        *SMALL,
        *BRIEF,
        "train.steps=2",
        "output=run",
    )
    trained = ("checkpoint=run/checkpoints/step_000002", "--trust-plugins")
    (saved,) = (tmp_path / "run").rglob("step_000002/config.json")
    assert json.loads(saved.read_text())["embodiment"]["name"] == "blink"

    loop = (*BLINK, *trained, "tasks=all", "workers=1")
    run(tmp_path, "blink", "evaluate", *loop, "episodes=2", "output=evaluated", "video=all")
    records = read_folders(find_records([tmp_path / "evaluated"]))
    assert [(r.task, r.episode, r.seed, r.env, r.video_frames) for r in records] == [
        ("Blink", 0, 500_000, "blink", 4),
        ("Blink", 1, 500_001, "blink", 4),
    ]
    assert len(list((tmp_path / "evaluated" / "videos").glob("*.mp4"))) == 2
    results([str(tmp_path / "evaluated")])  # this process does not know the environment
    assert "0.0 % of 2 episodes of Blink" in capsys.readouterr().out

    online = (
        "online=true",
        "episodes=1",
        "recordings=data",
        "recorded=1",
        "draws=2",
        "moments=1",
        "scan=false",
    )
    run(tmp_path, "blink", "probe", *loop, *online, "with=[shuffle]", "output=probed")
    assert (tmp_path / "probed" / "page.html").is_file()

    run(
        tmp_path,
        "blink",
        "play",
        *BLINK,
        "tasks=all",
        "episodes=4",
        "player=random",
        "output=played",
    )
    played = read_folders(find_records([tmp_path / "played"]))
    assert len(played) == 4 and {r.outcome for r in played} <= {"success", "fail"}


@pytest.mark.slow
def test_a_policy_of_an_environment_of_ones_own_is_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(
        "websockets", reason="the server's packages are not installed: the extra `serve` has them"
    )
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "blink")
    import_plugins(["blink"])
    source = environment("blink")
    spec = source.episode("Blink", "test", 0)
    observation, info = source.make(spec).reset(seed=spec.seed)
    frames = [*info["video"], observation]
    words = ("mme_vla", "serve", *BLINK, "model=framesamp_modul", *SMALL)
    with (
        commands.serving(*words, cwd=tmp_path, env=environment_of("blink")) as port,
        Client(f"ws://127.0.0.1:{port}") as client,
    ):
        client.reset()
        images, states = (np.stack([frame[key] for frame in frames]) for key in ("top", "state"))
        client.add_buffer(images, states, exec_start=len(frames) - 1)
        now = {f"observation/{key}": value for key, value in observation.items()}
        chunk = client.infer({**now, "prompt": info["goal"]})["actions"]
    assert chunk.shape == (4, 1) and np.isfinite(chunk).all()


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
def test_maniskills_pick_cube_is_recorded_trained_and_evaluated(tmp_path: Path) -> None:
    words = ("env=pick_cube", "plugins=[pick_cube]")
    out = run(tmp_path, "pick_cube", "record", *words, "tasks=all", "episodes=2", "output=data")
    assert "2 episodes" in out and "0 did not succeed" in out
    run(
        tmp_path,
        "pick_cube",
        "train",
        *words,
        "data.sources=[data]",
        "model=pi05",
        "backbone=nano",
        "train=nano",
        "train.steps=2",
        "train.save_every=2",
        "train.val_samples=0",
        "train.batch_size=4",
        "logger=none",
        "output=run",
    )
    run(
        tmp_path,
        "pick_cube",
        "evaluate",
        *words,
        "checkpoint=run/checkpoints/step_000002",
        "--trust-plugins",
        "tasks=all",
        "episodes=1",
        "workers=1",
        "max_steps=4",
        "output=evaluated",
    )
    (record,) = read_folders(find_records([tmp_path / "evaluated"]))
    assert (record.task, record.env, record.steps) == ("PickCube-v1", "pick_cube", 4)
