"""Several trainings of one recipe are one method, and two recipes are never averaged."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.rollout_fakes import quick_policy
from mme_vla.evaluation.records import EpisodeRecord, merge
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.compare import compare
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.tables import leaderboard, overview, runs_table
from mme_vla.evaluation.rollout.evaluation import facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import STATE
from mme_vla.policy.training_identity import KEY, TrainingIdentity, identify

PROTOCOL = Protocol(("StopCube",), 10)
CONFIG = {"seed": 3, "train": {"lr": 1e-3, "steps": 100, "workers": 2}, "data": {"jitter": False}}


def records(
    won: int, seed: int = 0, model_seed: int = 7, recipe: str = "r", model: str = "m"
) -> list[EpisodeRecord]:
    trained = TrainingIdentity(seed, recipe, "d", f"w{seed}")
    return [
        EpisodeRecord(
            model,
            100,
            model_seed,
            "StopCube",
            e,
            e,
            "easy",
            "success" if e < won else "fail",
            9,
            training=trained,
        )
        for e in range(10)
    ]


def test_trainings_that_differ_more_than_the_methods_decide_nothing() -> None:
    every = [*records(10), *records(0, seed=1)]
    every += [*records(0, model="other"), *records(0, seed=1, model="other")]
    results = aggregate(every, PROTOCOL)
    comparison = compare(*results.methods, PROTOCOL)
    assert (comparison.wins, comparison.losses) == (10, 0)
    assert comparison.interval.low <= 0 and comparison.p > 0.05 and not comparison.significant


def test_two_trainings_are_one_method_with_a_deviation_over_trainings() -> None:
    every = [
        *records(8),
        *records(6, model_seed=8),
        *records(3, seed=1),
        *records(3, seed=1, model_seed=8),
    ]
    results = aggregate(every, PROTOCOL)
    (method,) = results.methods
    assert method.label == "m" and len(method.trainings) == 2
    assert method.average.mean == pytest.approx(50) and method.average.std == pytest.approx(
        np.std([70, 30], ddof=1)
    )
    one = aggregate([*records(8), *records(6, model_seed=8)], PROTOCOL).methods[0].average
    assert (
        method.average.interval.high - method.average.interval.low
        > one.interval.high - one.interval.low
    )
    table, runs = overview(results), runs_table(results)
    assert table.rows[0][:3] == ["m", "2", "4"] and "over trainings" in table.title
    assert [row[1] for row in runs.rows] == ["0", "0", "1", "1"]
    assert leaderboard(method, results)[0].columns[1] == "Training 0, Seed 7"


def test_trainings_of_one_seed_differ_by_their_weights() -> None:
    def weighed(name: str | None, won: int, checkpoint: int = 100) -> list[EpisodeRecord]:
        trained = TrainingIdentity(0, "r", "d", name)
        return [replace(record, training=trained, checkpoint=checkpoint) for record in records(won)]

    def trainings(*parts: list[EpisodeRecord]) -> list[list[tuple[int | str, str | None]]]:
        (method,) = aggregate([record for part in parts for record in part], PROTOCOL).methods
        names = []
        for runs in method.trainings:
            named = [run.key.training or TrainingIdentity() for run in runs]
            keys = [run.key.checkpoint for run in runs]
            names.append([(key, one.weights) for key, one in zip(keys, named, strict=True)])
        return names

    two = weighed("a", 8), weighed("b", 2)
    assert trainings(*two) == [[(100, "a")], [(100, "b")]]
    average = aggregate([*two[0], *two[1]], PROTOCOL).methods[0].average
    assert average.interval and average.interval.low <= 20 and average.interval.high >= 80
    later = weighed("c", 8, 200), weighed("d", 2, 200)
    assert trainings(two[0], later[0]) == [[(100, "a"), (200, "c")]], "one training's checkpoints"
    assert trainings(*two, *later) == [[(100, "a"), (200, "c")], [(100, "b"), (200, "d")]]
    assert trainings(weighed(None, 8), two[0]) == [[(100, None), (100, "a")]]


def test_two_recipes_are_not_averaged() -> None:
    results = aggregate([*records(8, recipe="400"), *records(2, recipe="1200")], PROTOCOL)
    assert sorted(method.label for method in results.methods) == ["m#1200", "m#400"]
    assert "recipes of training" in results.notes[0] and "`recipe`" in results.notes[0]


def test_records_without_a_training_have_the_figures_they_had() -> None:
    base = [replace(record, training=None) for record in (*records(8), *records(6, model_seed=8))]
    read = merge([EpisodeRecord.from_json(record.to_json()) for record in base])
    lines = [
        {key: value for key, value in vars(record).items() if key != "training"} for record in read
    ]
    old = [EpisodeRecord.from_dict(line | {"seconds": {}}) for line in lines]
    figures = [aggregate(part, PROTOCOL).methods[0].average for part in (base, old)]
    assert figures[0] == figures[1] and figures[0].std == pytest.approx(np.std([80, 60], ddof=1))


def test_a_record_keeps_its_training() -> None:
    record = records(5)[0]
    assert EpisodeRecord.from_json(record.to_json()) == record
    assert record.run.training == TrainingIdentity(0, "r", "d", "w0")


def test_the_interval_of_a_difference_covers_trainings() -> None:
    every = [
        *records(9),
        *records(5, seed=1),
        *records(4, model="n"),
        *records(4, seed=1, model="n"),
    ]
    results = aggregate(every, PROTOCOL)
    wide = compare(results.method("m"), results.method("n"), PROTOCOL)
    assert (
        wide.difference == pytest.approx(30)
        and wide.interval.high >= 50
        and wide.interval.low <= 10
    )


def test_the_recipe_holds_what_changes_an_update() -> None:
    base = identify(CONFIG, ["abc"])
    assert (
        base["seed"] == 3 and identify({**CONFIG, "seed": 4}, ["abc"])["recipe"] == base["recipe"]
    )
    free = {**CONFIG, "train": {**CONFIG["train"], "workers": 8}}
    assert identify(free, ["abc"]) == base
    longer = {**CONFIG, "train": {**CONFIG["train"], "steps": 400}}
    assert identify(longer, ["abc"])["recipe"] != base["recipe"]
    for section, key in (
        ("policy", "stage"),
        ("policy", "subtask_weight"),
        ("data", "weights"),
    ):
        other = {**CONFIG, section: {**CONFIG.get(section, {}), key: "x"}}
        assert identify(other, ["abc"])["recipe"] != base["recipe"], key
    assert identify(CONFIG, ["xyz"])["data"] != base["data"]
    started = {start: identify({**CONFIG, "init_from": start}, ["abc"])["recipe"] for start in
               (None, "none", "lerobot/pi05_base", "/not/here/pi05_base")}  # fmt: skip
    assert started[None] == started["none"] == base["recipe"], "random weights"
    assert started["lerobot/pi05_base"] == started["/not/here/pi05_base"] != base["recipe"], (
        "the end of a path"
    )


def test_a_recipe_names_the_weights_that_it_starts_from(tmp_path: Path) -> None:
    checkpoint = tmp_path / "run" / "checkpoints" / "step_000010"
    quick_policy("pi05").save_pretrained(checkpoint)
    (checkpoint / STATE).write_text("{}")
    recipes = {
        identify({**CONFIG, "init_from": str(place)}, ["abc"])["recipe"]
        for place in (tmp_path / "run", checkpoint)
    }
    assert len(recipes) == 1


def test_records_copy_the_training_of_a_checkpoint(tmp_path: Path) -> None:
    policy = quick_policy("pi05")
    policy.config[KEY] = identify(CONFIG, ["abc"])
    policy.save_pretrained(tmp_path / "one")
    loaded = Policy.from_pretrained(str(tmp_path / "one"))
    facts = facts_of(loaded, None, "one", RolloutSettings(), None)
    assert facts.training is not None and facts.training.seed == 3 and facts.training.weights
    next(policy.parameters()).data += 1
    policy.save_pretrained(tmp_path / "two")
    other = facts_of(
        Policy.from_pretrained(str(tmp_path / "two")), None, "two", RolloutSettings(), None
    ).training
    assert (
        other == replace(facts.training, weights=other.weights if other else None)
        and other != facts.training
    )
