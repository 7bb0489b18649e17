"""Success over the dials of a stress split: one curve is of the same episodes, and the test split
is its zero.
"""

from dataclasses import replace
from pathlib import Path

import pytest

from helpers.rollout_fakes import records, save_records
from mme_vla.cli.results import main
from mme_vla.errors import UserError
from mme_vla.evaluation.results.curves import stress_curves, stress_figures, stress_table


def test_the_test_split_is_the_zero_of_every_dial_of_its_run() -> None:
    stress_records = [
        *records("test", [1, 1, 1, 0]),
        *records("stress:count=2", [1, 0, 0, 0]),
        *records("stress:count=5", [0, 0]),
    ]
    stress_records += [*records("stress:count=2", [1, 1], "other"), *records("twin", [1, 1])]
    curves = stress_curves(stress_records)
    mine = next(points for (run, *_), points in curves.items() if run.startswith("m,"))
    assert [(at, p.won, p.episodes) for at, p in mine.items()] == [(0, 2, 2), (2, 1, 2), (5, 0, 2)]
    other = next(points for (run, *_), points in curves.items() if run.startswith("other"))
    assert [(at, p.rate) for at, p in other.items()] == [(2, 100.0)]
    assert mine[0].interval.low < 100 == mine[0].interval.high and len(stress_figures(curves)) == 1


def test_twins_of_a_stress_split_have_a_curve_of_their_own() -> None:
    made = []
    for split, won in (
        ("test", [1, 0]),
        ("stress:count=2", [0, 0]),
        ("twin", [1, 1]),
        ("twin:stress:count=2", [1, 0]),
    ):
        made += records(split, won)
    curves = stress_curves(made)
    assert {run.rpartition(", ")[2]: {at: str(p) for at, p in points.items()}
            for (run, *_), points in curves.items()} == {
        "test": {0: "1/2", 2: "0/2"},
        "twin": {0: "2/2", 2: "1/2"},
    }  # fmt: skip


def test_a_curve_without_a_common_episode_is_named() -> None:
    made = [*records("test", [1]), *records("stress:count=2", [1, 0])[1:]]
    curves = stress_curves(made)
    table = stress_table(curves)
    assert not table.rows and not stress_figures(curves)
    (note,) = table.notes
    assert note.endswith("PickXtimes, count: no curve, since no episode is at all its places.")


def test_two_configurations_of_one_name_have_a_curve_each() -> None:
    stress_records = []
    for composition, won in (("first", 1), ("second", 0)):
        for split in ("test", "stress:count=2"):
            for record in records(split, [won, won]):
                stress_records.append(replace(record, composition=composition))
    curves = stress_curves(stress_records)
    assert [
        [(at, p.won, p.episodes) for at, p in points.items()] for points in curves.values()
    ] == [
        [(0, 2, 2), (2, 2, 2)],
        [(0, 0, 2), (2, 0, 2)],
    ]


def test_runs_are_drawn_in_the_order_of_their_records() -> None:
    stress_records = [record for run in "zab" for record in records("stress:count=2", [1, 0], run)]
    (figure,) = stress_figures(stress_curves(stress_records)).values()
    places = [figure.index(f">{run}") for run in "zab"]
    assert places == sorted(places)


def test_the_command_saves_the_curve(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, stress_records in (
        ("a", records("test", [1, 0])),
        ("b", records("stress:count=3", [0, 0])),
    ):
        save_records(tmp_path / name, stress_records)
    page = tmp_path / "page.html"
    main([str(tmp_path), "--stress", "--html", str(page), "--title", "a < b"])
    assert "Success over the dials" in capsys.readouterr().out
    text = page.read_text()
    assert "<svg" in text and "PickXtimes, count" in text and "<h1>a &lt; b</h1>" in text
    with pytest.raises(UserError, match="None of these records is of a stress split"):
        stress_curves(records("test", [1]))


def test_the_command_names_the_baselines_that_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for model in ("framesamp_modul", "ttt_modul"):
        save_records(tmp_path / model, records("stress:count=3", [0, 0], model))
    main([str(tmp_path), "--stress", "--markdown", str(tmp_path / "page.md")])
    for text in (capsys.readouterr().out, (tmp_path / "page.md").read_text()):
        assert "train present_modul to compare" in " ".join(text.split()).replace("\\", "")
