"""The README's *Try it* in other environments than RoboMME's, each command in a fresh process."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from helpers import commands
from mme_vla.embodiment import Embodiment
from mme_vla.envs.base import environment
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.serving.client import Client

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
TRAINED = "checkpoint=run/checkpoints/step_000002"


def run(folder: Path, variables: Mapping[str, str], command: str, *words: str) -> str:
    """Output of a command that runs in `folder`: without tracebacks and bars of other packages."""
    done = commands.run("mme_vla", command, *words, cwd=folder, env=variables)
    assert done.returncode == 0, done.stderr[-3000:]
    for noise in ("Traceback", "torchcodec", "it/s", "examples/s", "%|"):
        assert noise not in done.stdout + done.stderr, done.stderr[-3000:]
    return done.stdout


def try_commands(
    folder: Path, variables: Mapping[str, str], env: Sequence[str], tasks: str, *player: str
) -> list[EpisodeRecord]:
    """Record, inspect, train, evaluate, probe and play two scenes, into folders of `folder`.

    Args:
        folder: an empty one.
        variables: of the processes.
        env: the words that choose the environment.
        tasks: the word that chooses one task.
        player: the words of `play`.

    Returns:
        The records of the evaluation.
    """
    scenes = (*env, tasks, "episodes=2")
    run(folder, variables, "record", *scenes, "output=data")
    text = run(folder, variables, "inspect", *env, "dataset=data")
    assert "execution steps to train on" in text
    data = ("data.sources=[data]", "train.steps=2", "output=run")
    run(folder, variables, "train", *env, "model=framesamp_modul", *SMALL, *BRIEF, *data)

    policy = (*env, tasks, TRAINED, "--trust-plugins", "workers=1")
    run(folder, variables, "evaluate", *policy, "episodes=2", "output=evaluated", "video=all")
    records = read_folders(find_records([folder / "evaluated"]))
    assert len(list((folder / "evaluated" / "videos").glob("*.mp4"))) == len(records) == 2

    brief = ("recordings=data", "recorded=1", "draws=2", "moments=1", "scan=false")
    closed_loop = ("online=true", "with=[shuffle]", "output=probed")
    run(folder, variables, "probe", *policy, "episodes=1", *brief, *closed_loop)
    assert (folder / "probed" / "page.html").is_file()

    run(folder, variables, "play", *scenes, *player, "output=played")
    played = read_folders(find_records([folder / "played"]))
    assert len(played) == 2 and {record.outcome for record in played} <= {"success", "fail"}
    return records


def served_chunk(
    folder: Path, variables: Mapping[str, str], words: Sequence[str], env: str, task: str
) -> np.ndarray:
    """The chunk that a server answers to a scene's first frames, after the words of `serve`."""
    source = environment(env)
    spec = source.episode(task, "test", 0)
    scene = source.make(spec)
    observation, info = scene.reset(seed=spec.seed)
    now = {"observation/state": observation["state"], "prompt": info["goal"]}
    robot = Embodiment.from_dict(source.embodiment)
    for name in robot.camera_names:
        if callable(observation[name]):  # rendered on demand
            observation[name] = observation[name]()
        now[f"observation/{name}"] = observation[name]
    scene.close()
    frames = [*info.get("video", ()), observation]
    with (
        commands.serving("mme_vla", "serve", *words, cwd=folder, env=variables) as port,
        Client(f"ws://127.0.0.1:{port}") as client,
    ):
        client.reset()
        images = np.stack([frame[robot.memory_camera] for frame in frames])
        states = np.stack([frame["state"] for frame in frames])
        client.add_buffer(images, states, exec_start=len(frames) - 1)
        chunk: np.ndarray = client.infer(now)["actions"]
    return chunk
