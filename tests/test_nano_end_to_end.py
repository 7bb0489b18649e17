"""The whole way of nanoMME, small: two demonstrations, twenty updates, two episodes; needs the extra `sim`."""

from pathlib import Path

import forked
import pytest
from test_extras import hidden

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.envs import metadata
from mme_vla.envs.rendering_check import render_backend
from mme_vla.errors import UserError
from mme_vla.evaluation.record_log import find_records, read_folders
from mme_vla.nano.planner import Replay, replay

SMALL = (
    "demonstrations.easy=2", "demonstrations.medium=0", "demonstrations.hard=0", "train.steps=20",
    "train.batch_size=4", "train.val_every=10", "episodes=2", "max_steps=20", "beside=[]", "also=[]", "drawn_for=[]",
)  # fmt: skip


@pytest.mark.timeout(600)
def test_from_nothing_to_a_page_and_again_without_doing_anything_twice(tmp_path: Path) -> None:
    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))
    words = ["mme_vla.nano", "task=VideoUnmask", "model=framesamp_modul", *SMALL, f"output={tmp_path}"]
    done = forked.run(*words, hidden=hidden(("sim",)))  # the extra suffices alone
    assert done.returncode == 0, done.stderr
    records = read_folders(find_records([tmp_path / "framesamp_modul"]))
    assert [record.episode for record in sorted(records, key=lambda r: r.episode)] == [0, 1]
    assert {record.action_space for record in records} == {"waypoint"}
    page = (tmp_path / "page.md").read_text()
    assert "| framesamp_modul" in page and "| planner" in page and (tmp_path / "learning.png").is_file()
    films = list(tmp_path.glob("films/failure/**/*.mp4"))
    assert len(films) == 1 and films[0].name in page
    written = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    assert forked.run(*words).returncode == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")} == written
    assert len(read_folders(find_records([tmp_path / "framesamp_modul"]))) == 2


def test_what_the_demonstrator_does_solves_an_episode_through_the_actions_of_policies() -> None:
    spec = metadata.episode("VideoUnmask", "val", 0)
    record = replay(Replay(spec, max_steps=500))
    assert (record.model, record.outcome, record.seed) == ("planner", "success", spec.seed)
    assert replay(Replay(spec, max_steps=record.steps // 2)).outcome == "timeout"
