"""Each example trains, is saved, reopened, probed, served and evaluated in fresh processes, from another folder."""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from helpers import REPOSITORY, commands
from mme_vla.envs.rendering import render_backend
from mme_vla.errors import UserError
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.serving.client import Client
from mme_vla.training.logging import read_metrics

SMALL = ("backbone=tiny", "backbone.depth=2", "backbone.vision.depth=1", "backbone.vision.image_size=16",
         "backbone.vision.patch_size=1", "backbone.vision.width=16", "backbone.vision.mlp_dim=16")  # fmt: skip
BRIEF = ("train.steps=2", "train.batch_size=2", "train.val_samples=0", "train.open_loop_chunks=0", "train.workers=0",
         "train.device=cpu", "train.log_every=1", "logger=none")  # fmt: skip
PROBE = ("recordings=sample", "recorded=[0]", "draws=2", "moments=2", "scan=false", "flow_steps=2")


@dataclass(frozen=True)
class Row:
    """One example: its folder and file, its model, and words of its training.

    lines: most lines of the file. logged: a metric of its training. arms: interventions of the probe that reach it.
    page: of docs/extend, which shows the file.
    """

    name: str
    model: str
    words: tuple[str, ...] = ()
    lines: int = 60
    logged: str = "train/loss"
    arms: str = "[shuffle]"
    page: str = ""


ROWS = [
    Row(
        "repeat_frames",
        "framesamp_modul",
        ("experiment=hesitate", "memory.budget=64"),
        lines=25,
        arms="[hesitate:8]",
        page="history-transforms",
    ),
    Row(
        "write_head",
        "write_head_modul",
        ("train.losses={write: 0.1}", "memory.budget=64"),
        logged="train/losses/write",
        page="auxiliary-losses",
    ),
    Row("fifo", "fifo", arms="[drop:1]", page="cached-keys-and-values"),
    Row(
        "scratchpad",
        "scratchpad",
        ("data.texts={scratchpad: simple_subgoal}",),
        logged="train/losses/line",
        arms="[]",
        page="notes",
    ),
]
PARAMETERS = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)


def environment(row: Row) -> dict[str, str]:
    return {"PYTHONPATH": f"{REPOSITORY}:{REPOSITORY / 'examples' / row.name}", "OMP_NUM_THREADS": "1"}


def run(folder: Path, row: Row, module: str, *words: str) -> str:
    done = commands.run(f"mme_vla.{module}", *words, cwd=folder, env=environment(row))
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@PARAMETERS
def test_an_example_is_short_and_uses_no_private_name(row: Row) -> None:
    text = (REPOSITORY / "examples" / row.name / f"{row.name}.py").read_text()
    assert len(text.splitlines()) <= row.lines
    assert not re.findall(r"(?<!\w)_[a-z]\w*|\._[a-z]", re.sub(r"__\w+__", "", text))


@PARAMETERS
def test_the_page_of_an_example_shows_its_files_and_its_code_runs(row: Row, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, page = REPOSITORY / "examples" / row.name, (REPOSITORY / "docs" / "extend" / f"{row.page}.md").read_text()
    assert (folder / f"{row.name}.py").read_text().strip() in page
    monkeypatch.syspath_prepend(folder)
    monkeypatch.chdir(folder)
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)[1:]:
        exec(compile(block, f"docs/extend/{row.page}.md", "exec"), {})


@pytest.mark.slow
@PARAMETERS
def test_an_example_works_in_every_command(row: Row, tmp_path: Path) -> None:
    configs = str(REPOSITORY / "examples" / row.name / "configs")
    run(tmp_path, row, "train", "--config-dir", configs, f"model={row.model}", *SMALL, *BRIEF, *row.words,
        f"data.cache.root={tmp_path / 'caches'}", "output=run")  # fmt: skip
    metrics = [line[row.logged] for line in read_metrics(tmp_path / "run") if row.logged in line]
    assert len(metrics) == 2 and np.isfinite(metrics).all()
    trained = ("checkpoint=run/checkpoints/step_000002", "--trust-plugins")
    if row.arms != "[]":
        run(tmp_path, row, "probe", *trained, *PROBE, f"with={row.arms}", "output=probed")
        assert list((tmp_path / "probed").rglob("*.json*"))
    served(tmp_path, row, *trained)
    evaluated(tmp_path, row, *trained)


def served(folder: Path, row: Row, *words: str) -> None:
    """Two chunks of a server in a process of its own."""
    server = commands.start("mme_vla.serve", *words, "port=0", "flow_steps=2", cwd=folder, env=environment(row))
    try:
        lines = ""
        assert server.stderr is not None
        while "ready at ws://127.0.0.1:" not in lines and (line := server.stderr.readline()):
            lines += line
        port = int(lines.split("ready at ws://127.0.0.1:")[1].split()[0])
        image = np.zeros((256, 256, 3), np.uint8)
        with Client(f"ws://127.0.0.1:{port}") as client:
            client.reset()
            for first in (True, False):
                chunk = client.infer({
                    "task_goal": ["press the button"], "is_first_step": first, "front_rgb_list": [image],
                    "wrist_rgb_list": [image], "joint_state_list": [np.zeros(7)], "gripper_state_list": [np.zeros(2)],
                })["actions"]  # fmt: skip
                assert np.isfinite(chunk).all()
    finally:
        server.kill()
        server.wait()


def evaluated(folder: Path, row: Row, *words: str) -> None:
    """One short episode of the simulator, where it is installed."""
    pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim` has it")
    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))
    run(folder, row, "evaluate", *words, "tasks=StopCube", "episodes=1", "max_steps=18", "workers=1", "flow_steps=2",
        "output=evaluated")  # fmt: skip
    (record,) = read_folders(find_records([folder / "evaluated"]))
    assert record.outcome in ("success", "fail", "timeout"), record.error
    if row.name == "scratchpad":
        assert [line["frame"] for line in record.extra["notes"]] == sorted(
            {line["frame"] for line in record.extra["notes"]}
        )
        assert len(json.dumps(record.extra["notes"])) > 2
