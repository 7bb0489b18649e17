"""Rows of the board: what a folder must hold, and the ranking, tests, targets and pages that are
made of them.
"""

import json
import lzma
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import published
import pytest
from scipy.stats import kendalltau, spearmanr

from helpers.nano_rows import SCENES, SPLIT, TASKS, records_of, write_records, write_training
from mme_vla import UserError
from mme_vla.envs.metadata import episodes
from mme_vla.evaluation.results.statistics import percentiles
from mme_vla.evaluation.store import begin_run, read_folders
from mme_vla.extras.nano import board_page
from mme_vla.extras.nano.board import Board, Row, homogeneity, kendall, pooled, smallest_p, spearman
from mme_vla.extras.nano.cli import board as board_command
from mme_vla.extras.nano.cli import nano as nano_command
from mme_vla.extras.nano.rows import read_rows, read_training
from mme_vla.extras.nano.unpaired import unpaired_difference
from mme_vla.policy.training_identity import TrainingIdentity
from mme_vla.utils import write_json


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three memories of two trainings, a floor of as many parameters, one of random choices, and
    the demonstrator.
    """
    root = tmp_path_factory.mktemp("rows")
    solved = {"framesamp_modul": (3, 2), "ttt_modul": (2, 1), "rmt_modul": (1, 1)}
    for row, counts in solved.items():
        for seed, won in enumerate(counts):
            write_training(root, row, seed, won)
    write_training(root, "present_modul", 0, {"BinFill": 1})
    write_training(root, "random", 0, 0, "floor", trained=False, parameters=None, update_s=None)
    write_training(root, "demonstrator", 0, 3, "ceiling", trained=False)
    return root


@pytest.fixture(scope="module")
def board(rows: Path) -> Board:
    return Board(read_rows([rows]), samples=300)


def row_of(board: Board, name: str) -> Row:
    return next(row for row in board.rows if row.name == name)


def test_rows_are_ranked_by_their_mean_over_trainings(board: Board) -> None:
    names = ["demonstrator", "framesamp_modul", "ttt_modul", "rmt_modul", "present_modul", "random"]
    assert [row.name for row in board.rows] == names
    best = row_of(board, "framesamp_modul")
    assert best.average.mean == pytest.approx(100 * 5 / 6) and best.average.std == pytest.approx(
        np.std([100, 200 / 3], ddof=1)
    )
    assert {row.name: board.places[row.name][0] for row in board.ranked} == dict(
        zip(names[1:], range(1, 6), strict=True)
    )
    low, high = board.places["ttt_modul"][1]
    assert 1 <= low <= 2 <= high <= 4


def test_equal_rows_share_a_place(rows: Path, tmp_path: Path) -> None:
    for row, won in {"a": 2, "b": 2, "c": 1}.items():
        write_training(tmp_path, row, 0, won)
    places = Board(read_rows([tmp_path]), samples=50).places
    assert [places[name][0] for name in "abc"] == [1, 1, 3]


def test_trainings_lie_between_scenes_and_rows(board: Board, tmp_path: Path) -> None:
    """The noise between trainings is pooled over rows."""
    assert board.noise() == pytest.approx(
        pooled([np.array([100, 200 / 3]), np.array([200 / 3, 100 / 3]), np.full(2, 100 / 3)])
    )
    single, pair = row_of(board, "present_modul"), row_of(board, "rmt_modul")
    draws = board.draws([single, pair], board.protocol.tasks)
    without = Board(
        read_rows([write_training(tmp_path, "present_modul", 0, {"BinFill": 1}).parent]),
        samples=300,
    )
    assert draws[0].std() > without.draws(without.rows, without.protocol.tasks)[0].std() + 4
    assert board.noise(["BinFill"]) == pytest.approx(board.noise())


def test_intervals_have_the_noise_of_a_rows_number_of_trainings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # every scene of two tasks, none of the others: nothing changes with the scenes
    half = dict.fromkeys(TASKS[:2], 3)
    for row, seed in (("one", 0), ("four", 0), ("four", 1), ("four", 2), ("four", 3)):
        write_training(tmp_path, row, seed, half)
    write_training(
        tmp_path, "random", 0, half, "floor", trained=False, parameters=None, update_s=None
    )
    monkeypatch.setattr(Board, "_training_deviation", lambda *_: 4.0)
    board = Board(read_rows([tmp_path]))
    deviations = {name: draws.std() for name, draws in board.sampled.items()}
    assert deviations == pytest.approx({"one": 4, "four": 2, "random": 0}, rel=0.1)
    low, high = board.interval(row_of(board, "one"))
    assert (low, high) == pytest.approx((50 - 1.96 * 4, 50 + 1.96 * 4), abs=1)
    (difference,) = (
        c.interval for c in board.neighbours() if {c.first, c.second} == {"one", "four"}
    )
    assert difference.high - difference.low == pytest.approx(2 * 1.96 * 20**0.5, rel=0.1)


def test_policies_that_read_the_simulators_subgoals_are_ceilings(
    rows: Path, tmp_path: Path
) -> None:
    folder = write_training(tmp_path, "simplesg", 0, 3)
    write_records(folder, [replace(record, subgoal="oracle") for record in records_of(folder)])
    board = Board(read_rows([rows, tmp_path]), samples=50)
    assert row_of(board, "simplesg").kind == "ceiling" and "simplesg" not in board.places
    assert {s.memories for s in board.separations} == {3}
    assert "(framesamp_modul)" in board.targets()[0].measured


def test_users_rows_are_compared_with_the_rows_beside_the_best_and_the_floors(
    rows: Path, tmp_path: Path
) -> None:
    write_training(tmp_path, "mine", 0, {"BinFill": 3, "VideoUnmask": 2})
    board = Board(read_rows([rows], local=[tmp_path]), samples=50)
    pairs = [(c.first, c.second) for c in board.neighbours()]
    assert pairs == [
        ("ttt_modul", "mine"),
        ("mine", "rmt_modul"),
        ("framesamp_modul", "mine"),
        ("present_modul", "mine"),
    ]
    assert board.places["mine"][0] == 3 and board_page.standing(board)[0].startswith(
        "mine: place 3 of 6, between "
    )
    assert board_page.ranking(board).strong == {[row.name for row in board.rows].index("mine")}


def test_a_users_row_of_a_known_name_stands_beside_it(rows: Path, tmp_path: Path) -> None:
    write_training(tmp_path, "ttt_modul", 0, 3)
    read = read_rows([rows], local=[tmp_path])
    assert len(read["ttt_modul"]) == 2 and [t.is_local for t in read["ttt_modul (yours)"]] == [True]


def test_targets_have_intervals_and_are_not_reached_by_weak_evidence(
    board: Board, tmp_path: Path
) -> None:
    first, second, *suites = board.targets()
    assert first.measured == "83.3 % (framesamp_modul)" and first.reached
    assert second.measured == "10 % of it" and second.reached
    assert [t.name.rpartition(" ")[2] for t in suites] == list(board.protocol.suites)
    assert [t.test for t in suites] == [f"{n} : 0, p = 1.0000" for n in (2, 3, 3, 3)]
    assert not any(t.reached for t in suites)
    alone = Board(read_rows([write_training(tmp_path, "a", 0, 1).parent]), samples=50)
    assert [t.measured for t in alone.targets()] == ["33.3 % (a)", "not run yet"]
    for row in ("a", "present_modul"):
        write_training(tmp_path / "none", row, 0, 0)
    none = Board(read_rows([tmp_path / "none"]), samples=50)
    assert [t.measured for t in none.targets()] == ["0.0 % (a)", "not run yet"]


def test_tasks_that_separate_memories_stand_out() -> None:
    rng = np.random.default_rng(0)
    apart = [
        np.tile((np.arange(20) < n)[:, None], (1, 3)).astype(float) for n in (2, 6, 10, 14, 18)
    ]
    assert (
        homogeneity(apart, 999)
        == pytest.approx(0.001)
        == homogeneity(apart, 999, over_trainings=True)
    )
    alike = [rng.random((20, 3)) < 0.5 for _ in range(5)]
    assert homogeneity(alike, 999) > 0.05
    assert homogeneity([group[:, :1] for group in apart], 999) == pytest.approx(0.001)
    assert homogeneity([apart[0], *(group[:, :1] for group in apart[1:])], 999) == pytest.approx(
        0.001
    ), "one of three"
    mixed = [alike[0], *(group[:, :1] for group in alike[1:])]
    assert homogeneity(mixed, 999) > 0.05


def test_no_false_alarm_where_trainings_differ_as_much_as_memories() -> None:
    rng = np.random.default_rng(1)
    trainings = [
        np.tile((np.arange(20) < n)[:, None], 1).astype(float)
        for n in rng.permutation(np.arange(1, 19))
    ]
    groups = [np.concatenate(trainings[i : i + 3], 1) for i in range(0, 18, 3)]
    assert homogeneity(groups, 999, over_trainings=True) > 0.05


def test_the_homogeneity_test_keeps_its_level() -> None:
    rng = np.random.default_rng(2)
    p_values = [homogeneity([rng.random((6, 2)) < 0.5 for _ in range(4)], 99, seed, seed % 2 == 0)
                for seed in range(200)]  # fmt: skip
    assert 0.01 < np.mean(np.array(p_values) <= 0.05) < 0.1


def test_separations_state_deviation_noise_floor_and_ceiling(board: Board) -> None:
    made = board.separations
    assert [s.task for s in made] == list(board.protocol.tasks) and all(
        s.memories == 3 for s in made
    )
    first = made[0]
    assert (first.lowest, first.highest, first.ceiling) == pytest.approx((100 / 3, 500 / 6, 100))
    assert first.floor == pytest.approx(100 / 3) and made[1].floor == 0
    assert (
        first.noise == pytest.approx(board.noise())
        and first.repeated == 3
        and first.p_repeated is None
    )
    assert board_page.separating(board)[0].endswith(
        "the 3 trained policies differ in 0 of 4 tasks (p < 0.05)."
    )


def test_memories_below_the_floor_have_a_negative_distance_to_it(
    board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = board.separations[0]
    below = replace(first, mean=57.4, floor=85.0, ceiling=50.0)
    monkeypatch.setattr(board, "separations", [below])
    (row,) = board_page.separations(board).rows
    assert row[-2:] == ["-28", "-7"]


def test_variants_are_compared_that_differ_in_memory_or_integration_alone(
    rows: Path, tmp_path: Path
) -> None:
    """Memories with one integration, other budgets, floors and the user's rows are left out."""
    for row, won in {
        "framesamp_context": 2,
        "ttt_expert": 1,
        "ttt_context": 0,
        "framesamp_modul@4": 1,
    }.items():
        write_training(tmp_path / "more", row, 0, won)
    write_training(tmp_path / "mine", "framesamp_expert", 0, 3)
    board = Board(read_rows([rows, tmp_path / "more"], local=[tmp_path / "mine"]), samples=50)
    pairs = {
        part: [(c.first, c.second) for c in board.variants(part)]
        for part in ("memory", "integration")
    }
    assert pairs["integration"] == [
        ("framesamp_modul", "framesamp_context"),
        ("ttt_modul", "ttt_expert"),
        ("ttt_modul", "ttt_context"),
        ("ttt_expert", "ttt_context"),
    ]
    assert pairs["memory"] == [
        ("framesamp_context", "ttt_context"),
        ("framesamp_modul", "ttt_modul"),
    ]
    comparison = board.variants("memory")[0]
    assert comparison.difference == pytest.approx(200 / 3)
    assert comparison.interval == percentiles(
        board.sampled["framesamp_context"] - board.sampled["ttt_context"]
    )


def test_budgets_are_separate_tables(rows: Path, tmp_path: Path) -> None:
    for row in ("framesamp_modul@4", "ttt_modul@4", "framesamp_modul@16"):
        write_training(tmp_path, row, 0, 1, budget=int(row.partition("@")[2]))
    board = Board(read_rows([rows, tmp_path]), samples=50)
    assert [(s.budget, s.memories) for s in board.separations] == [("", 3)] * 4 + [("4", 2)] * 4
    assert "framesamp_modul" in board_page.budget_figure(board) and all(
        not row.budget for row, _ in board.published
    )


def test_rank_correlations_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    values, reference = (
        rng.integers(0, 6, (5, 14)).astype(float),
        rng.integers(0, 20, 14).astype(float),
    )
    for row, rho, tau in zip(
        values, spearman(values, reference), kendall(values, reference), strict=True
    ):
        assert rho == pytest.approx(spearmanr(row, reference)[0]) and tau == pytest.approx(
            kendalltau(row, reference)[0]
        )
    assert (
        np.isnan(spearman(np.ones(3), np.arange(3.0)))
        and kendall(np.arange(3.0), np.arange(3.0)) == 1
    )


def test_the_published_ranking_stands_beside(board: Board) -> None:
    assert [row.name for row, _ in board.published] == ["framesamp_modul", "ttt_modul", "rmt_modul"]
    agreements = {a.scope: a for a in board.agreements()}
    assert list(agreements) == [
        "average",
        "average, memories alone",
        *board.protocol.suites,
        *board.protocol.tasks,
    ]
    assert agreements["average"].spearman == 1 and agreements["average"].methods == 3
    assert agreements["average"].spearman_interval.low < 1
    cells = board_page.published(board).rows[0]
    assert cells[1] == "83.3 (1)" and cells[2].endswith("(1)")


def test_trainings_are_listed_with_the_scenes_each_solves(rows: Path, tmp_path: Path) -> None:
    """A row of one training has its scenes in the other tables."""
    for seed, solved in {3: {"BinFill": 3, "VideoUnmask": 1}, 11: 2}.items():
        write_training(tmp_path, "mine", seed, solved)
    board = Board(read_rows([rows, tmp_path]), samples=50)
    table = board_page.trainings(board)
    assert table.columns == ["row", "training seed", "all", *board.protocol.suites, *TASKS]
    assert [cells[1:] for cells in table.rows if cells[0] == "mine"] == [
        ["3", "4", "3", "1", "0", "0", "3", "1", "0", "0"],
        ["11", "8", *"2222", *"2222"],
    ]
    assert [cells[0] for cells in table.rows].count("framesamp_modul") == 2
    assert not {"present_modul", "random", "demonstrator"} & {cells[0] for cells in table.rows}


def test_the_page_holds_the_numbers(board: Board) -> None:
    html = board_page.page(board)
    for text in ("framesamp_modul", "83.33 ± 23.57", "1,419,194", "12.00", "0.130", "Targets"):
        assert text in html
    assert f"{board.noise():.1f} points (standard deviation)" in html
    assert "<svg" in html and "addEventListener" in html
    assert not re.search(r"(src|href)=.?http|@import|fetch\(", html)


def test_compressed_records_are_the_same(tmp_path: Path) -> None:
    folder = write_training(tmp_path, "framesamp_modul", 0, 3)
    unpacked = folder / "episodes.jsonl"
    packed = folder / "episodes.jsonl.xz"
    records = read_training(folder).records
    packed.write_bytes(lzma.compress(unpacked.read_bytes()))
    unpacked.unlink()
    assert read_training(folder).records == records
    assert len(read_folders([packed])) == SCENES * len(TASKS)
    packed.write_bytes(packed.read_bytes()[:-40])
    with pytest.raises(UserError, match="cut off"):
        read_training(folder)


@pytest.mark.parametrize("name", ["config.yaml", "run.json", "trained.json", "episodes.jsonl"])
def test_a_missing_file_is_named(tmp_path: Path, name: str) -> None:
    folder = write_training(tmp_path, "framesamp_modul", 0, 3)
    (folder / name).unlink()
    with pytest.raises(UserError, match=f"framesamp_modul/0.* {name}"):
        read_rows([tmp_path])


def test_an_episode_twice_is_named(tmp_path: Path) -> None:
    folder = write_training(tmp_path, "framesamp_modul", 0, 3)
    records = records_of(folder)
    write_records(folder, [replace(records[4], outcome="error", error="no"), *records])
    read_training(folder)  # an error that was repeated is no second result
    error = replace(records[4], outcome="error", error="no")
    write_records(folder, [*records[:4], error, *records[5:], error])
    assert len(read_training(folder).records) == len(records), "nor are two errors two results"
    write_records(folder, [*records, replace(records[4], outcome="fail")])
    with pytest.raises(UserError, match=r"framesamp_modul/0 has episodes twice: VideoUnmask 1"):
        read_training(folder)


def test_an_incomplete_split_is_named(tmp_path: Path) -> None:
    folder = write_training(tmp_path, "framesamp_modul", 0, 3)
    write_records(folder, records_of(folder)[:-2])
    with pytest.raises(
        UserError, match=r"first 3 scenes .* it lacks MoveCube 1, MoveCube 2, and has none"
    ):
        read_training(folder)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"split": "val"}, "split of BinFill 0 is val in its record, but further in run.json"),
        ({"seed": 1}, "BinFill 0 has seed 1 .*but that of split 'further' has"),
        ({"episode": 77}, "lacks BinFill 0, and has BinFill 77 beside"),
        (
            {"training": TrainingIdentity(0, "r", "d", "other")},
            "training of BinFill 0 is .*other.*trained.json",
        ),
        ({"training": TrainingIdentity(0, "r", "x", "framesamp_modul0")}, "training of BinFill 0"),
        ({"composition": "0123"}, "composition of BinFill 0 is 0123 .*config.yaml"),
        ({"checkpoint": 7}, "checkpoint of BinFill 0 is 7 .*run.json"),
        ({"max_steps": 900}, "max_steps of BinFill 0 is 900 .*, but 500 in run.json"),
        ({"made_up": True}, "made_up of BinFill 0 is True"),
    ],
)
def test_records_of_something_else_are_named(
    tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    folder = write_training(tmp_path, "framesamp_modul", 0, 3)
    first, *others = records_of(folder)
    write_records(folder, [replace(first, **change), *others])
    with pytest.raises(UserError, match=words) as error:
        read_rows([tmp_path])
    assert str(folder) in str(error.value)


def test_changed_settings_and_facts_are_named(tmp_path: Path) -> None:
    folder = write_training(tmp_path, "framesamp_modul", 0, 3)
    path, text = folder / "trained.json", (folder / "trained.json").read_text()
    path.write_text(json.dumps({**json.loads(text), "kind": "ladder"}))
    with pytest.raises(UserError, match=r"trained\.json.*kind.*'policy'|kind=.ladder"):
        read_training(folder)
    path.write_text(text)
    run = folder / "run.json"
    run.write_text(run.read_text().replace('"max_steps": 500', '"max_steps": 600'))
    with pytest.raises(UserError, match=r"run\.json is damaged"):
        read_training(folder)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("config.yaml", "[1, 2]", r"config.yaml must hold sections of keys, not \[1, 2\]"),
        ("config.yaml", "[" * 5000, r"config.yaml is damaged: .*RecursionError"),
        ("config.yaml", "name: a\nname: b", r"config.yaml is damaged: .*duplicate key name"),
        ("trained.json", {"cpu_minutes": -1.0}, r"cpu_minutes=-1.0 must be"),
        ("../../scenes.json", {"tried": [1]}, r"scenes.json: tried must be a section of keys"),
    ],
)
def test_a_file_of_another_form_is_named(tmp_path: Path, name: str, text: Any, words: str) -> None:
    folder = write_training(tmp_path, "framesamp_modul", 0, 3)
    file = folder / name
    if isinstance(text, dict):
        before = json.loads(file.read_text()) if file.exists() else {}
        text = json.dumps({**before, **text})
    file.write_text(text)
    with pytest.raises(UserError, match=words):
        read_training(folder)


def test_a_row_has_the_budget_of_its_name(tmp_path: Path) -> None:
    folder = write_training(tmp_path, "framesamp_modul@64", 0, 3)
    read_training(folder)
    (folder / "config.yaml").write_text("memory: {budget: 32}")
    with pytest.raises(UserError, match=r"has 64 memory tokens by its name, but 32 in config.yaml"):
        read_training(folder)


def test_scenes_that_cannot_be_built_are_replaced_by_later_ones(tmp_path: Path) -> None:
    folder = write_training(tmp_path, "a", 0, 2)
    write_json(
        tmp_path / "scenes.json",
        {"split": SPLIT, "tried": {"BinFill 1": "no place", "BinFill 0": ""}},
    )
    with pytest.raises(UserError, match="lacks BinFill 3, and has BinFill 1 beside them"):
        read_training(folder)
    spec, records = episodes("BinFill", SPLIT)[3], records_of(folder)
    records[1] = replace(records[1], episode=3, seed=spec.seed, difficulty=spec.difficulty)
    write_records(folder, records)
    assert [r.episode for r in read_training(folder).records if r.task == "BinFill"] == [0, 1, 2]


def test_rows_of_different_scenes_do_not_make_a_board(rows: Path, tmp_path: Path) -> None:
    folder = write_training(tmp_path, "mine", 0, 3)
    write_records(folder, [record for record in records_of(folder) if record.episode < 2])
    with pytest.raises(
        UserError, match=r"mine/0 and .* have different scenes or step limits: BinFill 2"
    ):
        read_rows([rows, tmp_path])


def test_rows_of_different_rules_do_not_make_a_board(rows: Path, tmp_path: Path) -> None:
    folder = write_training(tmp_path, "mine", 0, 3)
    settings = json.loads((folder / "run.json").read_text())["settings"]
    (folder / "run.json").unlink()
    begin_run(folder, {**settings, "max_actions": 20, "only_possible": True})
    with pytest.raises(
        UserError, match=r"mine/0 has .*, max_choices=20, only_possible=True, but .*None.*False"
    ):
        read_rows([rows, tmp_path])


def test_planned_motions_have_a_table_of_their_own(
    rows: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    motions = write_training(tmp_path / "run", "mine", 0, 2, action_space="waypoint").parents[1]
    with pytest.raises(
        UserError, match=r"has action_space=waypoint, .*, but .*action_space=multi_choice"
    ):
        read_rows([rows, motions])
    write_training(tmp_path / "waypoint", "pi05", 0, 1, action_space="waypoint")
    published.pack(tmp_path / "waypoint", tmp_path / "shipped" / "further-waypoint.tar.xz")
    monkeypatch.setattr(board_command, "SHIPPED", tmp_path / "shipped")
    board_command.main(
        [f"rows={motions}", "--samples", "50"], lambda: None, nano_command.with_settings
    )
    printed = capsys.readouterr().out
    assert "mine: place 1 of 2" in printed and "Actions are `waypoint`, not choices." in printed
    assert "Targets" not in printed, "which are of choices"


def test_trainings_of_a_row_are_of_one_recipe_and_not_copies(tmp_path: Path) -> None:
    write_training(tmp_path, "a", 0, 3)
    write_training(tmp_path, "a", 1, 3, recipe="longer")
    with pytest.raises(UserError, match="recipe is r and longer"):
        read_rows([tmp_path])
    write_training(tmp_path, "b", 1, 3, weights="b0")
    write_training(tmp_path, "b", 0, 3)
    with pytest.raises(UserError, match="they are one training"):
        read_rows([tmp_path / "b"])


def test_trainings_of_a_row_may_have_other_recordings_of_as_many_demonstrations(
    tmp_path: Path,
) -> None:
    write_training(tmp_path, "a", 0, 3, demonstrations={"BinFill": 4})
    write_training(tmp_path, "a", 1, 1, demonstrations={"BinFill": 4}, data="another processor")
    board = Board(read_rows([tmp_path]), samples=20)
    assert len(board.rows[0].method.trainings) == 2
    assert any(
        "(digests another processor, d)" in line and "more than one: 1 " in line
        for line in board_page.notes(board)
    )
    write_training(tmp_path, "a", 2, 1, demonstrations={"BinFill": 5})
    with pytest.raises(UserError, match=r"demonstrations is {'BinFill': 4} and {'BinFill': 5}"):
        read_rows([tmp_path])


def test_a_folder_without_rows_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no row"):
        read_rows([tmp_path])
    with pytest.raises(UserError, match="there is no such folder"):
        read_rows([tmp_path / "none"])


def test_the_command_prints_the_board_and_creates_the_page(
    rows: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_training(tmp_path, "mine", 0, 2)
    words = [
        "board",
        f"rows={rows}",
        f"rows={tmp_path}",
        "--html",
        str(tmp_path / "board.html"),
        "--samples",
        "50",
    ]
    monkeypatch.setattr(sys, "argv", ["mme-vla nano", *words])
    monkeypatch.setattr(board_command, "SHIPPED", tmp_path / "none")  # these rows have other scenes
    nano_command.main()
    printed = capsys.readouterr().out
    assert (
        "demonstrator" in printed
        and "mine: place 2 of 6" in printed
        and "Paired comparison" in printed
    )
    assert "<svg" in (tmp_path / "board.html").read_text()


def test_a_model_is_trained_before_the_board_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    typed: list[list[str]] = []

    def train() -> None:
        typed.append(sys.argv[1:])
        for row in ("framesamp_modul", "pi05", "of_another_command"):
            write_training(tmp_path / SPLIT, row, 0, 2, budget=None if row == "pi05" else 32)

    monkeypatch.setattr(sys, "argv", ["mme-vla nano", "board"])
    monkeypatch.setattr(board_command, "SHIPPED", tmp_path / "none")
    words = [
        "task=VideoUnmask",
        "model=framesamp_modul",
        f"split={SPLIT}",
        f"output={tmp_path}",
        "beside=[pi05]",
    ]
    board_command.main([*words, "--samples", "50"], train, nano_command.with_settings)
    assert typed == [[*words, "planner=false", "oracle=null", "floors=false", "trainings=1"]]
    printed = capsys.readouterr().out
    assert "framesamp_modul: place 1 of 2" in printed and "pi05: place 1 of 2" in printed
    with pytest.raises(SystemExit):
        board_command.main([f"split={SPLIT}"], train, nano_command.with_settings)
    assert len(typed) == 1 and "There are no rows" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("episodes=2", "episodes {'BinFill': 2, .* they have {'BinFill': 3,"),
        ("max_steps=9", "max_steps 9 .* 500"),
        ("max_choices=7", "max_choices=7, .* max_choices=None"),
        ("task=BinFill", "episodes {'BinFill': 3} does not fit"),
    ],
)
def test_a_row_that_does_not_fit_the_board_is_refused_before_it_is_trained(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    word: str,
    message: str,
) -> None:
    write_training(tmp_path / SPLIT, "framesamp_modul", 0, 2)
    published.pack(tmp_path / SPLIT, tmp_path / f"{SPLIT}.tar.xz")
    monkeypatch.setattr(board_command, "SHIPPED", tmp_path)
    words = [
        "nano=null",
        f"task=[{','.join(TASKS)}]",
        "model=framesamp_modul",
        f"split={SPLIT}",
        "episodes=3",
        "max_steps=500",
        "backbone=nano_choice",
        "embodiment=robomme_choice_front",
        "rendered_for=[]",
        f"output={tmp_path / 'out'}",
    ]
    trained: list[Path] = []

    def train() -> None:
        trained.append(write_training(tmp_path / "out" / SPLIT, "framesamp_modul", 1, 3))

    key = word.partition("=")[0]
    with pytest.raises(SystemExit):
        wrong = [word if each.partition("=")[0] == key else each for each in words]
        board_command.main(
            wrong if word in wrong else [*words, word], train, nano_command.with_settings
        )
    assert re.search(message, " ".join(capsys.readouterr().err.split())) and not trained
    board_command.main([*words, "--samples", "50"], train, nano_command.with_settings)
    assert len(trained) == 1 and "framesamp_modul (yours): place 1" in capsys.readouterr().out


def test_two_trainings_of_one_seed_are_refused_wherever_they_stand(tmp_path: Path) -> None:
    for folder, seed in (("a", 0), ("a", 1), ("b", 1)):
        write_training(tmp_path / folder, "mine", seed, 1)
    with pytest.raises(UserError, match="same seed or weights"):
        read_rows([tmp_path / "a", tmp_path / "b"])


def test_a_row_is_read_from_its_own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = write_training(tmp_path, "mine", 0, 1)
    monkeypatch.chdir(folder.parent)
    assert list(read_rows([Path()])) == ["mine"]


def test_errors_of_episodes_are_counted_beside_the_table(rows: Path, tmp_path: Path) -> None:
    folder = write_training(tmp_path, "mine", 0, 1)
    write_records(
        folder, [replace(r, outcome="error") if not r.episode else r for r in records_of(folder)]
    )
    board = Board(read_rows([rows], local=[tmp_path]), samples=50)
    assert (
        f"mine: {len(TASKS)} failures by an error of the environment or the policy."
        in board_page.notes(board)
    )


def test_a_board_names_the_standing_baselines_that_it_lacks(tmp_path: Path) -> None:
    for name in ("framesamp_modul", "present_modul"):
        write_training(tmp_path, name, 0, 1)
    notes = board_page.notes(Board(read_rows([tmp_path]), samples=20))
    assert [line for line in notes if "This table lacks" in line] == [
        "This table lacks actions_*, a memory of the robot's own past actions: train"
        " actions_modul to compare."
    ]


def test_a_trained_row_without_memory_is_a_floor_under_any_name(rows: Path, tmp_path: Path) -> None:
    write_training(tmp_path, "wide_pi05", 0, 3, budget=None)
    board = Board(read_rows([rows, tmp_path]), samples=50)
    assert (
        row_of(board, "wide_pi05").kind == "floor"
        and "(framesamp_modul)" in board.targets()[0].measured
    )


def test_a_row_that_solves_every_scene_has_an_interval(board: Board) -> None:
    low, high = board.interval(row_of(board, "demonstrator"))
    assert low < 90 and high == pytest.approx(100)


def test_memories_are_tested_over_trainings_where_they_have_enough(tmp_path: Path) -> None:
    assert smallest_p([2, 2]) == pytest.approx(1 / 3) and smallest_p([3] * 4) == pytest.approx(
        1 / 15_400
    )
    for number, row in enumerate("abcdef"):
        for seed in range(2 if row < "f" else 1):
            write_training(
                tmp_path, row, seed, {TASKS[0]: number // 2, TASKS[1]: (number + seed) % 4}
            )
    board = Board(read_rows([tmp_path]), samples=50)
    first, second = board.separations[:2]
    assert first.repeated == 5 and first.p_repeated == pytest.approx(
        4
        * homogeneity(
            [row.outcomes(TASKS[0]) for row in board.rows if len(row.method.trainings) > 1],
            over_trainings=True,
        )
    )
    assert first.p_repeated < 0.05 < second.p_repeated
    (sentence,) = board_page.separating(board)
    assert sentence.endswith(f"Tested over trainings, the 5 with several differ in 1: {TASKS[0]}.")


def test_a_users_row_of_a_known_name_has_its_budget(tmp_path: Path) -> None:
    for folder in ("theirs", "mine"):
        write_training(tmp_path / folder, "a@16", 0, 1, budget=16)
    rows = Board(read_rows([tmp_path / "theirs"], local=[tmp_path / "mine"]), samples=50).rows
    assert [row.budget for row in rows] == ["16", "16"]


def test_a_row_whose_trainings_differ_more_than_others_has_a_wider_interval(tmp_path: Path) -> None:
    half = dict.fromkeys(TASKS[:2], 3)
    for seed in range(8):
        write_training(tmp_path, "steady", seed, half)
    for seed, won in enumerate((half, {TASKS[0]: 3})):
        write_training(tmp_path, "restless", seed, won)
    board = Board(read_rows([tmp_path]))
    widths = {row.name: np.subtract(*board.interval(row)[::-1]) for row in board.rows}
    assert widths["restless"] > 2 * widths["steady"]


def test_few_scenes_with_equal_outcomes_are_no_certainty_unpaired() -> None:
    interval, p = unpaired_difference([np.ones((3, 1))], [np.zeros((3, 1))])
    assert interval.low < 0.2 and interval.high == 1.0 and 0.01 < p < 0.05
    interval, p = unpaired_difference([np.zeros((3, 1))], [np.zeros((3, 1))])
    assert interval.low < -0.3 and interval.high > 0.3 and p == 1.0


def test_the_package_has_the_published_rows() -> None:
    folder = board_command.published_rows("further")
    assert folder is not None
    assert len(list(folder.rglob("trained.json"))) > 50
    assert board_command.published_rows("further") == folder  # unpacked once
    assert board_command.published_rows("of_no_split") is None
