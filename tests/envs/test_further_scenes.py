"""Scenes beyond the official ones: their seeds, and that figures of them stand apart from the
benchmark's.
"""

from pathlib import Path

import pytest

from mme_vla.cli.results import main
from mme_vla.envs import metadata
from mme_vla.envs.metadata import FURTHER, FURTHER_EPISODES, MORE, TASK_NAMES
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord, RecordLog
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.scopes import Protocol


def test_they_continue_where_the_rule_of_the_test_split_ends() -> None:
    seeds, difficulties = zip(
        *(metadata.formula("MoveCube", "test", n) for n in range(50, 150)), strict=True
    )
    further = metadata.episodes("MoveCube", FURTHER)
    assert [spec.seed for spec in further] == list(seeds) and [
        spec.difficulty for spec in further
    ] == [*difficulties]
    assert (further[0].split, further[0].episode, further[0].recovery) == (FURTHER, 0, None)


@pytest.mark.parametrize("level", ["easy", "medium", "hard"])
def test_those_of_one_difficulty_are_picked_from_the_same_rule_in_its_order(level: str) -> None:
    rule = [metadata.formula("MoveCube", "test", n) for n in range(50, 1650)]
    expected = [seed for seed, difficulty in rule if difficulty == level][:400]
    specs = metadata.episodes("MoveCube", f"further_{level}")
    assert [spec.seed for spec in specs] == expected and {spec.difficulty for spec in specs} == {
        level
    }


@pytest.mark.parametrize("task", TASK_NAMES)
def test_no_other_split_of_the_task_has_them(task: str) -> None:
    others = {
        spec.seed for split in (*metadata.SPLITS, MORE) for spec in metadata.episodes(task, split)
    }
    further = {spec.seed for spec in metadata.episodes(task, FURTHER)}
    assert len(further) == FURTHER_EPISODES and not further & others


def records(split: str, count: int) -> list[EpisodeRecord]:
    return [
        EpisodeRecord(
            "pi05", 1, 7, "StopCube", n, n, "easy", "success" if n % 2 else "fail", 9, split=split
        )
        for n in range(count)
    ]


def test_they_are_never_averaged_with_official_episodes() -> None:
    both = [*records("test", 50), *records(FURTHER, 100)]
    with pytest.raises(UserError, match="several splits"):
        aggregate(both, Protocol(("StopCube",)))


def test_results_counts_a_hundred_of_them_and_sets_no_figure_of_the_paper_beside(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with RecordLog(tmp_path / "episodes.jsonl") as log:
        for record in records(FURTHER, 100):
            log.append(record)
    main([str(tmp_path), "--tasks", "StopCube"])
    table = capsys.readouterr().out
    assert "100" in table and "Incomplete" not in table and "none of the benchmark's" in table
    methods = aggregate(records(FURTHER, 100), Protocol(("StopCube",), 100)).methods
    assert (
        methods[0].paper is None
        and aggregate(records("test", 50), Protocol(("StopCube",))).methods[0].paper
    )
