"""Recording and showing: rendered episodes, datasets that can be read, runs that resume."""

import csv
import json
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.cli import gallery as show
from mme_vla.cli import record
from mme_vla.config.composition import compose, resolved
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes, open_episode
from mme_vla.envs.make import make_task
from mme_vla.envs.robomme.recording.recorder import Recorder
from mme_vla.errors import UserError
from mme_vla.utils.media import GAP, MARGIN, TILE

# a single move
SHORT = record.Job("PatternLock", 0, seed=0, difficulty="easy", recovery=None, retries=3)


pytestmark = pytest.mark.usefixtures("renderer")


@pytest.fixture(scope="module")
def recorded(renderer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with one recorded episode and its previews."""
    folder = tmp_path_factory.mktemp("recorded")
    record.record_episode(SHORT, folder, folder / "previews")
    yield folder


@pytest.mark.slow
def test_a_recorded_episode_reads_as_an_official_one(recorded: Path) -> None:
    about = json.loads((recorded / f"{SHORT.name}.json").read_text())
    (ref,) = list_episodes([recorded / f"{SHORT.name}.h5"])
    with open_episode(ref) as episode:
        frames = list(episode)
        assert (episode.length, episode.exec_start) == (about["stored"], about["video"])
        assert (episode.seed, episode.difficulty) == (about["seed"], "easy")
    assert frames[0].front.shape == (256, 256, 3)
    assert frames[0].front.std() > 10, "the scene is not rendered"
    assert {frame.subgoals["simple_subgoal"] for frame in frames} == {"move forward-right"}
    assert not np.array_equal(frames[0].front, frames[-1].front)
    assert {path.suffix for path in (recorded / "previews").iterdir()} == {".png", ".mp4"}


@pytest.mark.slow
def test_the_command_saves_both_layouts_and_only_what_is_missing(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    output = tmp_path / "dataset"
    cfg = compose(
        "record",
        ["task=PatternLock", "episodes=1", f"output={output}", f"hdf5={tmp_path / 'official'}"],
    )
    jobs = [SHORT]
    monkeypatch.setattr(record, "plan", lambda cfg: jobs)
    work = output.with_name("dataset.recording")
    record._claim(work, [job.plan for job in jobs])
    (work / "episodes").mkdir()
    for path in recorded.glob(f"{SHORT.name}.*"):
        (work / "episodes" / path.name).write_bytes(path.read_bytes())
    monkeypatch.setattr(
        record, "record_episode", lambda *_: pytest.fail("a finished episode was recorded again")
    )
    record.main(cfg)
    assert not work.exists()
    assert "1 episode, " in capsys.readouterr().out
    source = EpisodeSource(output)
    (ref,) = list_episodes(find_files([tmp_path / "official"]))
    with open_episode(ref) as episode:
        assert len(source) == 1
        assert len(source.states(0)) == episode.length
    tables = (output / "meta" / "facts.csv", *(tmp_path / "official").glob("*.facts.csv"))
    for table in tables:
        with table.open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert [row["fact"].split()[0] for row in rows] == ["1", "2", "3"][: len(rows)] and rows
        assert all(int(row["from"]) <= int(row["to"]) < len(source.states(0)) for row in rows)
        assert {row["task"] for row in rows} == {"PatternLock"}
    assert len(tables) == 2
    record.main(cfg)
    assert "all there already" in capsys.readouterr().out
    jobs.append(record.Job("PatternLock", 1, seed=1, difficulty="easy", recovery=None, retries=3))
    with pytest.raises(UserError, match="exists already"):
        record.main(cfg)


def test_a_folder_of_another_recording_is_refused(tmp_path: Path) -> None:
    record._claim(tmp_path, [SHORT.plan])
    other = record.Job("PatternLock", 1, seed=1, difficulty="easy", recovery=None, retries=3)
    with pytest.raises(UserError, match="other episodes"):
        record._claim(tmp_path, [SHORT.plan, other.plan])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["task=PickXtime", "episodes=1"], "Did you mean 'PickXtimes'"),
        (["task=PickXtimes", "episodes=0"], r"For number 0 alone write episodes=\[0\]"),
        (["task=PickXtimes", "episodes=[100]"], "100"),
        (["task=PickXtimes", "episodes=1", "workers=0"], "workers=0"),
        (["task=PickXtimes", "episodes=1", "split=training"], "train"),
    ],
)
def test_what_cannot_be_recorded_is_refused_by_name(words: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        config = resolved(compose("record", [*words, "output=somewhere"]))
        record.plan(record.RecordRun.from_config(config))


@pytest.mark.parametrize("task", ["VideoUnmask", "PickHighlight"])
def test_an_episode_with_and_without_a_video_is_rendered_to_its_success(task: str) -> None:
    env = make_task(task, render=True, seed=3, difficulty="easy")
    snapshots, success = show.demonstrate_with_images(env, every=40)
    env.close()
    assert success
    assert len(snapshots) >= 3
    assert all(shot.image.shape == (256, 256, 3) and shot.image.std() > 10 for shot in snapshots)
    changed = [np.abs(a.image.astype(int) - b.image).mean() for a, b in pairwise(snapshots)]
    assert max(changed) > 1, "nothing moves"
    assert show.strip(snapshots, tiles=4).width == 2 * MARGIN + 4 * (TILE + GAP) - GAP


def test_the_first_waypoint_of_the_execution_is_not_lost_with_those_of_the_video() -> None:
    env = make_task("RouteStick", render=False, seed=16000, difficulty="easy")
    recorded = Recorder(env, render=False).record()
    env.close()
    assert recorded.success
    named = [
        step.action["waypoint_action"] for step in recorded.frames if not step.info["is_video_demo"]
    ]
    distinct = [w for i, w in enumerate(named) if i == 0 or not np.array_equal(w, named[i - 1])]
    assert not np.isnan(distinct[0]).any()
    moves = sum(subtask.choice != "" and not subtask.video for subtask in env.progress.subtasks)
    assert len(distinct) == 2 * moves, "each arc has a middle and an end"
