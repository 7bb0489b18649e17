"""The commands that `kill.py` kills, each so small that a run takes seconds, and what of their results is compared."""

import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

SMALL = [
    "model=tokendrop_expert", "backbone.depth=1", "backbone.vision.depth=1", "backbone.vision.image_size=32",
    "backbone.vision.patch_size=2", "memory.budget=64",
]  # fmt: skip
RECIPE = [
    "train.steps=3", "train.save_every=1", "train.log_every=1", "train.val_every=2", "train.val_samples=1",
    "train.batch_size=1", "train.open_loop_chunks=1", "train.device=cpu", "train.workers=0", "train.keep.last=1",
    "logger=none",
]  # fmt: skip
# What only tells when and how fast, and the seals of lines that do.
_TIMES = re.compile(r'"(?:seconds|when|begun|speed/\w+|memory/gib|crc32)": ?(?:"[^"]*"|\{[^}]*\}|[-+.\w]+)')


@dataclass(frozen=True)
class Command:
    """One command.

    prepare: makes what it reads, once, in a folder. run: carries it out, with that folder and the one it writes to.
    """

    prepare: Callable[[Path], None]
    run: Callable[[Path, Path], object]


def results(folder: Path) -> dict[str, str]:
    """A hash of every file below a folder, without what only tells the time."""
    sums = {}
    for path in sorted(folder.rglob("*")):
        if path.is_dir():
            continue
        data = path.read_bytes()
        if path.suffix in (".json", ".jsonl"):
            data = _TIMES.sub("", data.decode()).replace(str(folder), "").encode()
        elif path.suffix == ".yaml":
            data = data.decode().replace(str(folder), "").encode()
        sums[path.relative_to(folder).as_posix()] = hashlib.sha256(data).hexdigest()
    return sums


def _train(inputs: Path, folder: Path) -> None:
    from mme_vla.cli.train import main
    from mme_vla.config.composition import compose

    words = [*SMALL, *RECIPE, f"data.cache.root={inputs}", f"output={folder / 'run'}", "resume=auto"]
    main(compose("train", words))


def _cache(inputs: Path, folder: Path) -> None:
    from mme_vla.cli.cache import main as run
    from mme_vla.config.composition import compose

    run(compose("cache", [*SMALL, f"data.cache.root={folder}", "device=cpu"]))


def _write_demonstrations(folder: Path) -> None:
    from h5_files import write_file

    write_file(folder / "record_dataset_Alpha.h5", [6, 5], videos=[2, 0], size=64)
    write_file(folder / "record_dataset_Beta.h5", [4], size=64)


def _convert(inputs: Path, folder: Path) -> None:
    from mme_vla.cli.convert import main as run
    from mme_vla.config.composition import compose

    run(compose("convert", [f"input={inputs}", f"output={folder / 'dataset'}"]))


def _evaluate(inputs: Path, folder: Path) -> None:
    import torch
    from rollout_stand_ins import FACTS, JOBS, InlineEnvs, make_scripted_env, quick_policy

    import mme_vla.evaluation.rollout.evaluation as module
    from mme_vla.evaluation.rollout.settings import RolloutSettings

    class Envs(InlineEnvs):
        """The environments in this process: what is killed is the command itself."""

        def __init__(self, jobs: Any, workers: int, factory: Any, options: Any, timeout: float) -> None:
            super().__init__(workers, **options)

        def __enter__(self) -> "Envs":
            return self

        def __exit__(self, *_: object) -> None:
            pass

    module.VecEnv = Envs  # type: ignore[assignment, misc]
    torch.manual_seed(0)
    settings = RolloutSettings(max_steps=24, flow_steps=2, max_batch=1, video="all", workers=1)
    policy = quick_policy("pi05")
    module.evaluate(policy, JOBS[1:4], folder / "run", FACTS, settings, base=make_scripted_env, show_progress=False)


class _Recorder:
    """Stands in for the simulator: the steps of a demonstration, synthetic."""

    def __init__(self, task: Any, on_step: Callable[[Any], None], render_request: Any) -> None:
        self._seed, self._on_step = task.seed, on_step

    def record(self) -> Any:
        from mme_vla.data.hdf5 import SUBGOALS
        from mme_vla.envs.recording.recorder import RecordedStep, Recording

        rng = np.random.default_rng(self._seed)
        for step in range(4):
            images = {f"{view}_rgb": rng.integers(0, 255, (64, 64, 3), np.uint8) for view in ("front", "wrist")}
            state = {"joint_state": rng.normal(size=7).astype(np.float32), "gripper_state": np.zeros(2, np.float32)}
            info = {**dict.fromkeys(SUBGOALS, "move"), "is_video_demo": step < 1, "is_completed": False}
            self._on_step(RecordedStep({**images, **state}, {"joint_action": rng.normal(size=8)}, info))
        return Recording(success=True, steps=4, stored=4, video=1)


def _record(inputs: Path, folder: Path) -> None:
    import mme_vla.cli.record as module
    import mme_vla.envs.recording.recorder as recorder
    from mme_vla.config.composition import compose

    def make_task(name: str, seed: int, difficulty: str, **_: Any) -> Any:
        return SimpleNamespace(
            seed=seed, difficulty=difficulty, choices=lambda: [], goals=lambda: ["do it"], close=lambda: None
        )

    module.make_task, recorder.Recorder = make_task, _Recorder  # type: ignore[assignment, misc]
    module.require_simulator = lambda: None
    words = ["task=[StopCube,PickXtimes]", "episodes=1", "workers=1", f"output={folder / 'dataset'}"]
    module.run(compose("record", [*words, f"hdf5={folder / 'official'}"]))


def _nothing(inputs: Path) -> None:
    pass


def _warm_cache(inputs: Path) -> None:
    _cache(inputs, inputs)


COMMANDS = {
    "train": Command(_warm_cache, _train),
    "cache": Command(_nothing, _cache),
    "convert": Command(_write_demonstrations, _convert),
    "record": Command(_nothing, _record),
    "evaluate": Command(_nothing, _evaluate),
}
