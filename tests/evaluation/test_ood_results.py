"""Results on RoboMME-OOD: by tier beside the published figures, twins, and success beyond the
training range.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mani_skill", reason="amounts come from scenes, which need the extra 'sim'")

from helpers.rollout_fakes import save_records
from mme_vla.cli.results import main
from mme_vla.envs import metadata
from mme_vla.errors import SceneError
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


def test_rates_are_means_over_tasks_beside_published_figures_of_the_same() -> None:
    records = made("PickXtimes", "ood", [1] * 50) + made("StopCube", "ood", [0] * 10)
    (table,) = ood.tier_tables(records)
    row = dict(zip(table.columns, table.rows[-1], strict=True))
    assert (row["task"], row["all"], row["%"]) == ("all", "50/60", "50.0")
    assert row["GroundSG+Oracle"] == "58.0", "of these two tasks"
    assert table.notes[0].endswith("has 60 of the 100 episodes that published figures are of.")

    hard = ood.hard_table(made("PickXtimes", "hard", [1] * 4) + made("StopCube", "hard", [0]))
    assert hard is not None and hard.rows[0][1:3] == ["4/5", "50.0"]
    assert hard.notes[0].endswith("has 5 of the 192 episodes that published figures are of.")

    records = made("StopCube", "test", [0] * 10) + made("StopCube", "twin", [0] * 10)
    records += made("PickXtimes", "test", [0]) + made("PickXtimes", "twin", [1])
    twins = ood.twin_table(records)
    assert twins is not None
    row = dict(zip(twins.columns, twins.rows[0], strict=True))
    assert (row["episodes"], row["lost by memory"], row["lost by control"]) == (
        "11",
        "+50.0",
        "50.0",
    )
    (interval,) = [
        method.average.interval
        for method in aggregate(
            [record for record in records if record.split == "twin"],
            Protocol.of_records(records),
        ).methods
    ]
    assert interval is not None
    assert row["twin (%)"] == f"50.0 [{interval.low:.1f}, {interval.high:.1f}]"


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


def test_an_episode_whose_scene_cannot_be_built_is_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def make_task(*_: object, **options: object) -> None:
        raise SceneError("target_1 finds no place.")

    monkeypatch.setattr(ood, "make_task", make_task)
    ood.amount_of.cache_clear()
    assert ood.extrapolation(made("StopCube", "test", [1, 0])) == {}
    ood.amount_of.cache_clear()


def test_a_scene_of_two_splits_counts_once() -> None:
    full = made("StopCube", "test", [1] * 8) + made("StopCube", "ood", [1] * 50)
    parts = made("StopCube", "hard", [0, 0]) + made("StopCube", "ood:xhard2", [0] * 4)
    alone = ood.extrapolation(full)
    assert ood.extrapolation(full + parts) == alone
    (points,) = ood.extrapolation(parts).values()
    assert sum(share.episodes for share in points.values()) == 6
    more = ood.extrapolation(full + made("StopCube", "hard", [0, 0, 0]))
    counts = [sum(p.episodes for p in points.values()) for points in (*alone.values(),)]
    assert counts == [58] and sum(p.episodes for p in next(iter(more.values())).values()) == 59


def test_the_papers_figures_do_not_stand_beside_other_episodes() -> None:
    for split in ("ood", "hard", "challenge", "twin:ood", "twin", "stress:count=2", "val", "train"):
        results = aggregate(
            made("StopCube", split, [1] * 12, model="framesamp_modul"), Protocol(("StopCube",), 12)
        )
        assert results.methods[0].paper is None
        assert any("none of the benchmark's" in note for note in results.notes)
    others = [replace(r, env="mine") for r in made("StopCube", "test", [1], "framesamp_modul")]
    alone = Protocol(("StopCube",), 1)
    assert aggregate(others, alone).methods[0].paper is None
    assert aggregate([replace(r, env=None) for r in others], alone).methods[0].paper


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
