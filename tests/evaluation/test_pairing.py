"""Episodes are paired where their scenes are the same, and nowhere else: a second machine with the
same seeds is none.

The second machine is simulated: its records have the seeds of the first, and other digests in some
episodes.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from helpers.nano_rows import SCENES, TASKS, records_of, write_records, write_training
from helpers.rollout_fakes import JOBS, quick_policy, records, roll, save_records
from helpers.scripted_env import ScriptedEnv
from mme_vla import UserError
from mme_vla.cli.results import main
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, merge
from mme_vla.evaluation.results.aggregate import aggregate, repeated_episodes
from mme_vla.evaluation.results.compare import compare, pair_methods
from mme_vla.evaluation.results.events import event_curves, event_table
from mme_vla.evaluation.results.ood import amount_of, twin_table
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.rollout.environment import EpisodeFactory
from mme_vla.extras.nano.board import Board, homogeneity
from mme_vla.extras.nano.board_page import notes
from mme_vla.extras.nano.page import compared
from mme_vla.extras.nano.rows import read_rows
from mme_vla.extras.probing import card as card_module
from mme_vla.extras.probing.run import _paired
from mme_vla.extras.trajectories.local import LocalEnvs

HERE = ["a0", "a1", "a2", "a3"]
THERE = ["a0", "b1", "a2", "b3"]
PROTOCOL = Protocol(("PickXtimes",), episodes=4)


def named(run: Sequence[EpisodeRecord], scenes: Sequence[str | None]) -> list[EpisodeRecord]:
    """Records of a machine whose scenes have these digests."""
    return [replace(record, scene=scene) for record, scene in zip(run, scenes, strict=True)]


def sides(*scenes: Sequence[str | None]) -> list[dict[EpisodeKey, list[EpisodeRecord]]]:
    runs = [named(records("test", [1] * len(of_side)), of_side) for of_side in scenes]
    return [{record.key: [record] for record in run} for run in runs]


@pytest.mark.parametrize(
    "first, second, paired, unnamed, other",
    [
        (HERE, HERE, 4, 0, 0),
        (HERE, THERE, 2, 0, 2),
        ([None] * 4, [None] * 4, 4, 4, 0),
        (HERE, [None] * 4, 0, 0, 4),
        ([None, NO_VALUES, NOT_BUILT, "a"], [NO_VALUES, None, NOT_BUILT, "a"], 4, 3, 0),
        (["a", NO_VALUES, NOT_BUILT, "d"], ["a", "b", "c", "e"], 2, 0, 2),
    ],
    ids=str,
)
def test_equal_digests_are_paired_or_none_on_both_sides(
    first: list[str | None],
    second: list[str | None],
    paired: int,
    unnamed: int,
    other: int,
) -> None:
    pairing = pair(sides(first, second))
    assert (len(pairing.keys), pairing.unnamed, pairing.left_out) == (paired, unnamed, other)
    turned = pair(sides(second, first))
    assert (turned.keys, turned.other) == (pairing.keys, pairing.other)


def test_an_episode_that_ended_before_its_scene_was_built_counts_in_comparisons() -> None:
    broken = named(records("test", [0] * 4, "m"), [NOT_BUILT] * 4)
    broken = [replace(record, outcome="error") for record in broken]
    every = [*broken, *named(records("test", [1] * 4, "n"), HERE)]
    first, second = aggregate(every, PROTOCOL).methods
    result = compare(first, second, PROTOCOL)
    assert (result.episodes, result.losses, result.notes) == (4, 4, ())


def test_other_seeds_are_other_scenes_without_a_digest_too() -> None:
    first, second = sides([None], [None])
    changed = {
        key: [replace(record, seed=99) for record in of_key] for key, of_key in second.items()
    }
    assert pair([first, changed]).other == {"PickXtimes": 1}


def test_all_runs_of_a_side_must_be_of_one_scene() -> None:
    first, second = sides(["a"], ["a"])
    (key,) = first
    assert pair([{key: [*first[key], replace(first[key][0], scene="b")]}, second]).keys == ()


def test_two_methods_are_compared_on_the_scenes_that_both_machines_built(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    every = [
        *named(records("test", [1, 1, 1, 0], "m"), HERE),
        *named(records("test", [0, 0, 1, 0], "n"), THERE),
    ]
    first, second = aggregate(every, PROTOCOL).methods
    result = compare(first, second, PROTOCOL)
    assert (result.episodes, result.wins, result.losses, result.first_rate) == (2, 1, 0, 100.0)
    save_records(tmp_path, every)
    main([str(tmp_path), "--tasks", "PickXtimes", "--episodes", "4", "--brief"])
    printed = capsys.readouterr().out
    assert "m − n: 2 episodes not paired (PickXtimes 2), for the scenes are different" in printed


def test_one_episode_that_is_not_paired_is_counted_as_one() -> None:
    first = {("PickXtimes", 0): named(records("test", [1]), ["a"])}
    second = {("PickXtimes", 0): named(records("test", [0]), ["b"])}
    (note,) = pair([first, second]).gaps("m − n")
    assert note.startswith("m − n: 1 episode not paired (PickXtimes 1), for the scenes")


@pytest.mark.parametrize(
    "scenes, reason",
    [
        (["b0", "b1", "b2", "b3"], "are different ones"),
        ([None] * 4, "only some of the runs name the scene"),
    ],
)
def test_nothing_in_common_is_said_and_not_compared(
    scenes: list[str | None], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    every = [
        *named(records("test", [1] * 4, "m"), HERE),
        *named(records("test", [0] * 4, "n"), scenes),
    ]
    save_records(tmp_path, every)
    options = [
        str(tmp_path),
        "--tasks",
        "PickXtimes",
        "--episodes",
        "4",
        "--brief",
    ]
    main(options)
    printed = capsys.readouterr().out
    assert reason in printed and "Paired comparison" not in printed
    with pytest.raises(SystemExit):
        main([*options, "--compare", "m", "n"])
    assert reason in " ".join(capsys.readouterr().err.split())
    first, second = aggregate(every, PROTOCOL).methods
    assert pair_methods(first, second).keys == ()


def test_pairs_without_digests_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_records(tmp_path, [*records("test", [1] * 4, "m"), *records("test", [0] * 4, "n")])
    main([str(tmp_path), "--tasks", "PickXtimes", "--episodes", "4", "--brief"])
    assert "4 of 4 paired episodes have no digest of their scene" in capsys.readouterr().out


# What records are made of -------------------------------------------------------------------------


class NamedEnv(ScriptedEnv):
    """An environment that names its scene."""

    scene_digest = "0123456789abcdef"


class BrokenEnv(ScriptedEnv):
    """An environment that breaks when its scene is built."""

    def reset(self) -> Any:
        raise RuntimeError("no scene")


@pytest.mark.parametrize("kind, scene", [(NamedEnv, "0123456789abcdef"), (ScriptedEnv, NO_VALUES),
                                         (BrokenEnv, NOT_BUILT)])  # fmt: skip
def test_every_record_names_its_scene_or_says_why_not(kind: Any, scene: str) -> None:
    def make(task: str, split: str, episode: int, max_steps: int) -> Any:
        return kind(task, episode, max_steps, travel=1.0, step_s=0.0, dies="")

    envs = LocalEnvs(EpisodeFactory(base=make, max_steps=8))
    (record,) = roll(quick_policy("pi05"), JOBS[:1], envs, retries=0, max_steps=8)
    assert record.scene == scene
    assert EpisodeRecord.from_json(record.to_json()) == record


def test_records_from_before_there_were_digests_are_read() -> None:
    (record,) = records("test", [1])
    values = json.loads(record.to_json())
    del values["scene"], values["crc32"]
    assert EpisodeRecord.from_dict(values).scene is None


# Siblings: everything else that takes the same seed for the same scene ----------------------------


def test_events_are_matched_with_the_same_scenes() -> None:
    with_event = [
        replace(record, event="pause:10") for record in named(records("test", [0] * 4), THERE)
    ]
    every = [*named(records("test", [1] * 4), HERE), *with_event]
    table = event_table(every)
    row = dict(zip(table.columns, table.rows[0], strict=True))
    assert (row["pairs"], row["lost"]) == ("2", "2") and "2 episodes not paired" in table.notes[0]
    (points,) = event_curves(every).values()
    assert [point.episodes for point in points.values()] == [2, 2]


def test_twins_are_the_same_scenes() -> None:
    every = [*named(records("test", [0] * 4), HERE), *named(records("twin", [1] * 4), THERE)]
    table = twin_table(every)
    assert (
        table is not None and table.rows[0][1] == "2" and "2 episodes not paired" in table.notes[0]
    )


def test_arms_of_a_probe_are_of_the_same_scenes() -> None:
    every = [
        *named(records("test", [1] * 4, "m"), HERE),
        *named(records("test", [0] * 4, "m · drop"), THERE),
    ]
    (comparison,) = _paired(every, "test", "m")
    assert comparison.episodes == 2 and comparison.notes


def test_a_report_card_takes_the_scenes_that_all_arms_have() -> None:
    mine, other = sides(HERE, THERE)
    same = pair([mine, other])
    assert list(card_module._success(mine, same.keys)) == [
        EpisodeKey("PickXtimes", 0),
        EpisodeKey("PickXtimes", 2),
    ]


def test_the_page_of_a_nano_run_compares_the_same_scenes() -> None:
    runs = {
        "m": named(records("test", [1] * 4, "m"), HERE),
        "n": named(records("test", [0] * 4, "n"), THERE),
    }
    results, (comparison,) = compared(runs, "PickXtimes", "test", "n")
    assert comparison.episodes == 2 and any(
        "2 episodes not paired" in note for note in results.notes
    )


def test_a_run_in_two_scenes_is_refused_and_no_repetition() -> None:
    first, second = (named(records("test", [1]), [scene]) for scene in ("a", "b"))
    with pytest.raises(UserError, match=r"was run in different scenes: a at .*, b at "):
        merge([*first, *second])
    assert merge([*first, *second], "first") == first
    assert repeated_episodes([*first, *second]) == {}
    later = [replace(record, when="2100-01-01T00:00:00+00:00") for record in first]
    assert list(repeated_episodes([*first, *later]).values()) == [(1, 0)]


def test_runs_of_one_method_in_other_scenes_are_told() -> None:
    every = [
        *named(records("test", [1] * 4), HERE),
        *named(records("test", [1] * 4, seed=8), THERE),
    ]
    assert any(
        "not known to be of the same scenes in 2 episodes" in note
        for note in aggregate(every, PROTOCOL).notes
    )


def test_amounts_of_another_scene_are_not_those_of_the_one_built_here() -> None:
    pytest.importorskip("mani_skill", reason="amounts come from scenes, which need the extra 'sim'")
    key = EpisodeKey("StopCube", 0)
    assert amount_of("StopCube", "test", key) is not None
    assert amount_of("StopCube", "test", key, "0123456789abcdef") is None


# The board ----------------------------------------------------------------------------------------


def name_scenes(folder: Path, prefix: str) -> None:
    write_records(
        folder, [replace(r, scene=f"{prefix}{r.task}{r.episode}") for r in records_of(folder)]
    )


@pytest.fixture
def rows(tmp_path: Path) -> Path:
    """Committed rows, whose records name no scene."""
    for row, won in {"framesamp_modul": 3, "ttt_modul": 1}.items():
        write_training(tmp_path / "rows", row, 0, won)
    return tmp_path / "rows"


def test_a_row_that_names_its_scenes_is_compared_by_score_with_rows_that_do_not(
    rows: Path, tmp_path: Path
) -> None:
    name_scenes(write_training(tmp_path / "mine", "mine", 0, 2), "a")
    board = Board(read_rows([rows], [tmp_path / "mine"]), samples=200)
    assert [row.name for row in board.apart] == ["mine"]
    comparisons = {(c.first, c.second): c for c in board.neighbours()}
    assert len(comparisons) == 2 and not any(c.paired for c in comparisons.values())
    beside = comparisons["framesamp_modul", "mine"]
    assert beside.difference == pytest.approx(100 / 3) and beside.better_worse == "not paired"
    assert beside.interval.low < beside.difference < beside.interval.high and 0 < beside.p < 1
    assert any(line.startswith("mine: not known to be of the same scenes") for line in notes(board))
    assert board.separations and all(s.memories == 2 for s in board.separations), (
        "no memory of other scenes"
    )


@pytest.mark.parametrize("prefix, paired", [("a", True), ("b", False)])
def test_rows_of_two_machines_are_paired_where_their_scenes_are_the_same(
    prefix: str, paired: bool, rows: Path, tmp_path: Path
) -> None:
    for folder in rows.glob("*/0"):
        name_scenes(folder, "a")
    name_scenes(write_training(tmp_path / "mine", "mine", 0, 2), prefix)
    board = Board(read_rows([rows], [tmp_path / "mine"]), samples=200)
    assert [c.paired for c in board.neighbours()] == [paired] * 2
    assert bool(board.apart) is not paired


def test_rows_without_digests_are_paired_as_before(rows: Path) -> None:
    board = Board(read_rows([rows]), samples=200)
    (comparison,) = board.neighbours()
    assert comparison.paired and comparison.wins == len(TASKS) * (SCENES - 1) and board.apart == []
    assert 0 < homogeneity([row.outcomes(TASKS[0]) for row in board.rows]) <= 1
