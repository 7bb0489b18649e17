"""Each example trains, is saved and reopened by the commands that reach its code, from another
folder.
"""

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from helpers import REPOSITORY, commands
from mme_vla.serving.client import Client
from mme_vla.training.logging import read_metrics

SMALL = (
    "backbone=tiny",
    "backbone.depth=2",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=16",
    "backbone.vision.patch_size=1",
    "backbone.vision.width=16",
    "backbone.vision.mlp_dim=16",
)
BRIEF = (
    "train.steps=2",
    "train.batch_size=2",
    "train.val_samples=0",
    "train.open_loop_chunks=0",
    "train.workers=0",
    "train.device=cpu",
    "train.log_every=1",
    "logger=none",
)
PROBE = ("recordings=sample", "recorded=[0]", "draws=2", "moments=2", "scan=false", "flow_steps=2")


@dataclass(frozen=True)
class Row:
    """One example: its folder and file, its model, and words of its training.

    logged: a metric of its training. arms: interventions of the probe that reach it. served:
    whether the server runs it too. page: of docs/extend, which shows the file.
    """

    name: str
    model: str
    words: tuple[str, ...] = ()
    logged: str = "train/loss"
    arms: str = ""
    served: bool = True
    page: str = ""


ROWS = [
    Row(
        "repeat_frames",
        "framesamp_modul",
        ("experiment=hesitate", "memory.budget=64"),
        arms="[hesitate:8]",
        served=False,
        page="history-transforms",
    ),
    Row(
        "write_head",
        "write_head_modul",
        ("train.losses={write: 0.1}", "memory.budget=64"),
        logged="train/losses/write",
        arms="[shuffle]",
        page="auxiliary-losses",
    ),
]
PARAMETERS = pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
EXAMPLES = REPOSITORY / "examples"
SHORT = [
    *(EXAMPLES / name / f"{name}.py" for name in ("blink", *(row.name for row in ROWS))),
    *sorted((EXAMPLES / "trajectories").glob("*.py")),
]
MOST_LINES = {"repeat_frames": 30, "blink": 55}
"""File → most lines; of others 75."""


def environment(row: Row) -> dict[str, str]:
    return {"PYTHONPATH": f"{REPOSITORY}:{EXAMPLES / row.name}", "OMP_NUM_THREADS": "1"}


def run(folder: Path, row: Row, module: str, *words: str) -> str:
    done = commands.run(f"mme_vla.{module}", *words, cwd=folder, env=environment(row))
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.parametrize("file", SHORT, ids=lambda file: file.stem)
def test_an_example_is_short_and_uses_no_private_name(file: Path) -> None:
    text = file.read_text()
    assert len(text.splitlines()) <= MOST_LINES.get(file.stem, 75)
    assert not re.findall(r"(?<!\w)(?<!self\.)(?<!def )_[a-z]\w*", text)


@PARAMETERS
def test_the_page_of_an_example_shows_its_files_and_its_code_runs(
    row: Row, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, page = (
        EXAMPLES / row.name,
        (REPOSITORY / "docs" / "extend" / f"{row.page}.md").read_text(),
    )
    assert (folder / f"{row.name}.py").read_text().strip() in page
    monkeypatch.syspath_prepend(folder)
    monkeypatch.chdir(folder)
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)[1:]:
        exec(compile(block, f"docs/extend/{row.page}.md", "exec"), {})


@pytest.mark.nightly
@PARAMETERS
def test_an_example_works_in_its_commands(row: Row, tmp_path: Path) -> None:
    configs = str(EXAMPLES / row.name / "configs")
    run(
        tmp_path,
        row,
        "train",
        "--config-dir",
        configs,
        f"model={row.model}",
        *SMALL,
        *BRIEF,
        *row.words,
        f"data.cache.root={tmp_path / 'caches'}",
        "output=run",
    )
    metrics = [line[row.logged] for line in read_metrics(tmp_path / "run") if row.logged in line]
    assert len(metrics) == 2 and np.isfinite(metrics).all()
    trained = ("checkpoint=run/checkpoints/step_000002", "--trust-plugins")
    if row.arms:
        run(tmp_path, row, "probe", *trained, *PROBE, f"with={row.arms}", "output=probed")
        assert list((tmp_path / "probed").rglob("*.json*"))
    if row.served:
        served(tmp_path, environment(row), "flow_steps=2", *trained)


def served(folder: Path, env: dict[str, str], *words: str) -> None:
    """Two chunks of a server in a process of its own."""
    image = np.zeros((256, 256, 3), np.uint8)
    with (
        commands.serving("mme_vla.serve", *words, cwd=folder, env=env) as port,
        Client(f"ws://127.0.0.1:{port}") as client,
    ):
        client.reset()
        for first in (True, False):
            chunk = client.infer(
                {
                    "task_goal": ["press the button"],
                    "is_first_step": first,
                    "front_rgb_list": [image],
                    "wrist_rgb_list": [image],
                    "joint_state_list": [np.zeros(7)],
                    "gripper_state_list": [np.zeros(2)],
                }
            )["actions"]
            assert np.isfinite(chunk).all()


# A method and a command, in a package of their own ------------------------------------------------

METHOD = EXAMPLES / "one_layer"


@pytest.fixture
def installed(tmp_path: Path) -> str:
    """The folders of an installed `one_layer`, as `PYTHONPATH` has them."""
    project = tomllib.loads((METHOD / "pyproject.toml").read_text())["project"]
    metadata = tmp_path / "site" / "one_layer-0.1.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: one-layer\nVersion: 0.1\n")
    lines = [f"[{group}]" for group in project["entry-points"]]
    lines += [f"{k} = {v}" for k, v in project["entry-points"]["mme_vla.plugins"].items()]
    (metadata / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return f"{REPOSITORY}:{METHOD}:{metadata.parent}"


def test_the_shortest_method_is_short_and_the_page_shows_its_names() -> None:
    files = sorted((METHOD / "one_layer").glob("*.py"))
    texts = [file.read_text() for file in files]
    assert sum(len(text.splitlines()) for text in texts) <= 75
    page = (REPOSITORY / "docs" / "extend" / "add-a-method.md").read_text()
    snippet = (METHOD / "one_layer" / "extension.py").read_text().partition("from pathlib")[2]
    assert f"from pathlib{snippet}" in page
    entry_point = (METHOD / "pyproject.toml").read_text().partition("[project.entry")[2]
    assert f"[project.entry{entry_point}" in page


@pytest.mark.slow
def test_the_shortest_method_and_its_command_work(installed: str, tmp_path: Path) -> None:
    env = {"PYTHONPATH": installed, "OMP_NUM_THREADS": "1"}
    for words in (
        ("train", "model=one_layer", *BRIEF, "output=run"),
        ("one-layer", "run", "--trust-plugins"),
    ):
        done = commands.run("mme_vla", *words, cwd=tmp_path, env=env)
        assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout == "66,560 weights\n"
    losses = [line["train/loss"] for line in read_metrics(tmp_path / "run")]
    assert len(losses) == 2 and np.isfinite(losses).all()
    served(tmp_path, env, "checkpoint=run", "--trust-plugins")
    recomputing = ("train.gradient_checkpointing=true", "output=again")
    words = ("train", "model=one_layer", *BRIEF[:-1], *recomputing)
    done = commands.run("mme_vla", *words, cwd=tmp_path, env=env)
    assert done.returncode != 0 and "OneLayer cannot recompute activations" in done.stderr
    words = ("analyse", "cost", "--models", "one_layer")
    done = commands.run("mme_vla", *words, cwd=tmp_path, env=env)
    assert done.returncode != 0 and "OneLayer has no full_batch()" in done.stderr
