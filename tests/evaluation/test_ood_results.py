"""Results on RoboMME-OOD: by tier beside the published figures, twins, and success beyond the
training range.
"""

from collections.abc import Sequence
from pathlib import Path

import pytest

pytest.importorskip("mani_skill", reason="amounts come from scenes, which need the extra 'sim'")

from helpers.rollout_fakes import save_records
from mme_vla.cli.results import main
from mme_vla.envs import metadata
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results import ood
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.scopes import Protocol


def made(
    task: str, split: str, wins: Sequence[int], model: str = "m", year: int = 2026
) -> list[EpisodeRecord]:
    specs = metadata.episodes(task, split)
    outcomes = ["success" if won else "fail" for won in wins]
    return [
        EpisodeRecord(
            model, 1, 7, task, spec.episode, spec.seed, spec.difficulty, outcome, 10, split=split,
            when=f"{year}-01-01T00:00:00+00:00",
        )
        for spec, outcome in zip(specs, outcomes, strict=False)
    ]  # fmt: skip


def test_success_is_counted_by_tier_beside_the_published_figures() -> None:
    records = made("PickXtimes", "ood", [1] * 17 + [0] * 33) + made(
        "StopCube", "ood:xhard2", [1, 0]
    )
    full, tier = ood.tier_tables(records)
    row = dict(
        zip(full.columns, next(row for row in full.rows if row[0] == "PickXtimes"), strict=True)
    )
    assert (row["xhard1"], row["xhard2"], row["xhard4"], row["all"]) == (
        "17/17",
        "0/17",
        "–",
        "17/50",
    )
    assert (row["GroundSG+Oracle"], row["SimpleMemVLA"], row["PonderPounce"]) == (
        "96.0",
        "0.0",
        "80.0",
    )
    assert "development records" in full.title
    assert [row[:3] for row in tier.rows] == [["StopCube", "–", "1/2"], ["all", "–", "1/2"]]


def test_published_totals_are_the_sums_of_their_tasks() -> None:
    for row in ood.paper_table("ood"):
        assert sum(int(row[task]) for task in ood.PAPER_ORDER) == int(row["all"])


def test_twins_tell_what_memory_and_what_control_loses() -> None:
    records = made("StopCube", "ood", [1, 0, 0, 0]) + made("StopCube", "twin:ood", [1, 1, 1, 0])
    records += made("StopCube", "ood", [1, 1, 0, 0], year=2027)
    table = ood.twin_table(records, conflicts="first")
    assert table is not None and len(table.rows) == 1
    row = dict(zip(table.columns, table.rows[0], strict=True))
    assert (row["episodes"], row["lost by memory"], row["lost by control"]) == (
        "4",
        "+50.0",
        "25.0",
    )
    assert (row["gained : lost"], row["flips of equal runs"]) == ("2 : 0", "1 of 4")
    assert ood.twin_table(made("StopCube", "ood", [1])) is None


def test_success_is_set_against_the_amount_over_all_splits() -> None:
    records = [r for split, wins in (("test", [1, 1]), ("stress:count=2", [1, 0]), ("ood", [0, 0]))
               for r in made("StopCube", split, wins)]  # fmt: skip
    curves = ood.extrapolation(records)
    (points,) = curves.values()
    test = [ood.amount_of("StopCube", "test", record.key) for record in records[:2]]
    assert [ood.amount_of("StopCube", "stress:count=2", record.key) for record in records[:2]] == [
        n + 2 for n in test
    ]
    assert set(points) == {*test, *(n + 2 for n in test), 6} and points[6].episodes >= 2
    table = ood.extrapolation_table(curves)
    assert {row[4] for row in table.rows if int(row[3]) > 5} == {"beyond"}
    assert {row[4] for row in table.rows if int(row[3]) <= 5} <= {"trained"}
    assert "<svg" in next(iter(ood.extrapolation_figures(curves).values()))


def test_the_papers_figures_do_not_stand_beside_other_episodes() -> None:
    for split in ("ood", "hard", "challenge", "twin:ood"):
        results = aggregate(
            made("StopCube", split, [1] * 12, model="framesamp_modul"), Protocol(("StopCube",), 12)
        )
        assert results.methods[0].paper is None
        assert any("none of the benchmark's" in note for note in results.notes)


def test_the_command_writes_the_tables(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_records(tmp_path, made("PatternLock", "ood", [1, 0]) + made("PatternLock", "hard", [1, 0]))
    page, text = tmp_path / "page.html", tmp_path / "page.md"
    main([str(tmp_path), "--ood", "--html", str(page), "--markdown", str(text)])
    visible = capsys.readouterr().out
    assert (
        "RoboMME-OOD" in visible and "Hard test episodes" in visible and "Extrapolation" in visible
    )
    assert "SimpleMemVLA" in text.read_text() and "<svg" in page.read_text()


def test_records_without_a_table_of_this_kind_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_records(tmp_path, made("MoveCube", "ood", [1, 0]))
    main([str(tmp_path), "--ood"])
    assert "Extrapolation" not in capsys.readouterr().out, "nothing grows in MoveCube"
    save_records(tmp_path / "plain", made("MoveCube", "test", [1, 0]))
    with pytest.raises(SystemExit):
        main([str(tmp_path / "plain"), "--ood"])
    assert "None of these records is of RoboMME-OOD" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--ood --stress", "--stress and --ood: name one"),
        ("--ood --csv t.csv", "--csv: not with --ood"),
    ],
)
def test_views_exclude_each_other(
    words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_records(tmp_path, made("PatternLock", "ood", [1]))
    with pytest.raises(SystemExit):
        main([str(tmp_path), *words.split()])
    assert message in capsys.readouterr().err
