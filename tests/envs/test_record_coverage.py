"""Recording beyond the benchmark's episodes: their seeds, and which goals of the test split they
cover.
"""

import json
from pathlib import Path

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.h5_files import write_file
from mme_vla.cli import record
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.envs import metadata
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import MORE, TASK_NAMES, EpisodeSpec
from mme_vla.envs.robomme.recording import coverage
from mme_vla.envs.robomme.recording.outputs import RecordingPlan


def test_more_episodes_have_seeds_that_no_split_has() -> None:
    seeds = {
        spec.seed
        for task in TASK_NAMES
        for split in metadata.SPLITS
        for spec in metadata.episodes(task, split)
    }
    more = [spec for task in TASK_NAMES for spec in metadata.episodes(task, MORE)]
    assert len({spec.seed for spec in more}) == len(more) == 900 * len(TASK_NAMES)
    # Where a demonstration fails the seed is raised by one, up to a hundred times.
    assert min(spec.seed for spec in more) > max(seeds) + 100
    assert more[0].recovery is None and [spec.difficulty for spec in more[:4]] == [
        "easy",
        "easy",
        "medium",
        "hard",
    ]


def test_goals_without_a_demonstration_are_named_with_their_episodes() -> None:
    specs = [EpisodeSpec("StopCube", "test", i, i, "easy") for i in range(4)]
    requests = list(zip(specs, ["third", "second", "third", "fifth"], strict=True))
    result = coverage.compare({"StopCube": {"second"}, "BinFill": {"third"}}, requests)["StopCube"]
    assert result == {
        "goals": 3, "goals_covered": 1, "episodes": 4, "episodes_covered": 1,
        "missing": {"third": [0, 2], "fifth": [3]},
    }  # fmt: skip
    assert coverage.in_words({"StopCube": result}).splitlines() == [
        "StopCube: 1 of 3 goals of 'test', 1 of 4 episodes",
        "  never shown: third (episode 0, 2)",
        "  never shown: fifth (episode 3)",
    ]
    result = coverage.compare({"StopCube": {"second", "third", "fifth"}}, requests)["StopCube"]
    assert result["missing"] == {}


def test_a_goal_is_what_the_scene_says() -> None:
    spec = metadata.episode("StopCube", "test", 1)
    task = make_task("StopCube", render=False, seed=spec.seed, difficulty=spec.difficulty)
    assert coverage.goal_of(spec) == task.goals()[0].lower()
    task.close()


@pytest.mark.parametrize("lerobot", [True, False])
def test_a_recording_is_compared_with_the_test_split(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    lerobot: bool,
) -> None:
    # whose goals are "do task 0" and "do task 1"
    write_file(tmp_path / "record_dataset_StopCube.h5", [6, 7])
    refs = list_episodes(find_files([tmp_path]))
    jobs = [record.Job("StopCube", ref.index, 0, "easy", None, 1) for ref in refs]
    dataset = tmp_path / "data" if lerobot else None
    if dataset is not None:
        convert(refs, dataset, ConvertOptions(images="png"))
    request = RecordingPlan(jobs, dataset, None if lerobot else tmp_path)
    monkeypatch.setattr(record, "goal_of", lambda spec: f"do task {spec.episode % 3}")
    record.report_coverage("StopCube", request, tmp_path / "coverage.json", workers=1)
    result = json.loads((tmp_path / "coverage.json").read_text())["StopCube"]
    assert (
        result["goals"],
        result["goals_covered"],
        result["episodes"],
        result["episodes_covered"],
    ) == (3, 2, 50, 34)
    assert list(result["missing"]) == ["do task 2"] and result["missing"]["do task 2"][:2] == [2, 5]
    assert "StopCube: 2 of 3 goals of 'test', 34 of 50 episodes" in capsys.readouterr().out


def test_throughput_is_reported_in_words() -> None:
    assert record._throughput(90, 27_000, 1800, 4) == (
        "90 episodes in 1800 s with 4 workers: 180 episodes and 54,000 steps an hour."
    )
