"""benchmarks/mikasa_table.py: what a run lacks is carried out, once, and stands in the table."""

import json
import re
from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks import mikasa_table
from benchmarks.mikasa_table import (
    MODELS,
    MOST_STEPS,
    SELECTING,
    TASKS,
    agreements,
    measure,
    summary,
)
from helpers import REPOSITORY
from helpers.published import published_folder
from helpers.rollout_fakes import save_records
from mme_vla.config.composition import compose
from mme_vla.envs.base import environment
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.store import read_folders
from mme_vla.extras.mikasa.catalog import FAMILY_OF, STEPS

CHOSEN = ["RememberColor3", "SeqOfColors3"]


def arguments(output: Path, **more: object) -> Namespace:
    values = {
        "output": output, "tasks": CHOSEN, "models": ["framesamp_modul", "pi05"], "seeds": 2,
        "demonstrations": 3, "scenes": 2, "tower_steps": 1, "demonstrated": 1,
        "steps": 5, "episodes": 2, "pairs": 1, "most_steps": MOST_STEPS, "jobs": 1,
    }  # fmt: skip
    return Namespace(**{**values, **more})


@pytest.fixture(autouse=True)
def no_tower(monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies to start from are empty folders."""
    monkeypatch.setattr(mikasa_table, "make_tower", lambda *args: None)
    monkeypatch.setattr(
        mikasa_table, "save_initial_policy", lambda tower, folder, seed: folder.mkdir(parents=True)
    )


class Commands:
    """Commands that write what the real ones do; the one of number `stop` is interrupted."""

    def __init__(self, stop: int | None = None) -> None:
        self.done: list[str] = []
        self.stop = stop

    def __call__(self, words: Sequence[str]) -> None:
        if len(self.done) == self.stop:
            raise KeyboardInterrupt
        named = dict(word.split("=", 1) for word in words if "=" in word)
        name = words[0]
        if name == "record":
            self._write(Path(named["output"]) / "meta" / "info.json", {})
        if name == "train":
            assert named["resume"] == "auto" and named["train.steps"] == "5"
            self._write(Path(named["output"]) / "summary.json", {})
        if name == "evaluate":
            folder = Path(named["output"])
            tasks = named["tasks"].strip("[]").split(",")
            is_short = [STEPS[task] <= MOST_STEPS for task in tasks]
            assert all(is_short) if "max_steps" not in named else not any(is_short)
            records = []
            for task in tasks:
                for episode in range(2):
                    outcome = "fail" if episode else "success"
                    record = EpisodeRecord(
                        folder.parent.parent.name, 5, 42, task, episode, episode, "", outcome, 10
                    )
                    records.append(record)
            folder.mkdir(parents=True, exist_ok=True)
            save_records(folder / "episodes.jsonl", records)
        if name == "probe":
            accuracy = {"unprobed": {"accuracy": 0.5, "pairs": 1, "chance": 0.1}}
            self._write(
                Path(named["output"]) / "twins.json", {"tasks": {"RememberColor3": accuracy}}
            )
        if name == "analyse":
            tasks = {
                "RememberColor3": {"storage": 1.0, "update": None},
                "SeqOfColors3": {"storage": 0.25, "update": 0.5},
            }
            self._write(Path(words[-1]), {"framesamp_modul": {"tasks": tasks}})
        self.done.append(name)

    def _write(self, path: Path, values: object) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(values))


def test_every_row_is_made_once(tmp_path: Path) -> None:
    commands = Commands()
    rows = measure(arguments(tmp_path), commands)
    assert [path.name for path in sorted((tmp_path / "tower").iterdir())] == [
        "policy-0", "policy-1",
    ]  # fmt: skip
    once = ["train", "evaluate", "evaluate", "probe"]
    assert commands.done == ["record", "record", *once, "analyse", *once, *once, *once]
    assert len(rows) == 8
    assert rows[1] == {
        "model": "framesamp_modul", "seed": "0", "task": "SeqOfColors3", "memory": "Capacity",
        "successes": "1", "episodes": "2", "twin_accuracy": "", "twin_pairs": "",
        "twin_chance": "", "storage": "0.25", "update": "0.5",
    }  # fmt: skip
    assert [row["storage"] for row in rows if row["model"] == "pi05"] == [""] * 4
    again = Commands()
    assert measure(arguments(tmp_path), again) == rows and again.done == []
    text = summary(rows)
    assert "| framesamp_modul | 4 | 0.500 | 0.500 | 0.625 | 0.500 |" in text
    assert "train present_modul to compare" in text


def test_the_ranking_is_compared_with_nanomme_and_the_paper() -> None:
    order = ["pi05", "present_modul", "ttt_modul", "framesamp_modul", "tokendrop_modul"]
    rows = []
    for i, model in enumerate(order):
        for task in CHOSEN:
            accuracy = str(1 - 0.2 * i) if task == "RememberColor3" else ""
            row = {"model": model, "task": task, "successes": str(i), "episodes": "10"}
            rows.append({**row, "twin_accuracy": accuracy})
    success, of_paper, twins, *_ = agreements(rows)
    assert "success with nanoMME-16, 5 models and 2 tasks: 1.00 [1.00, 1.00]" in success
    assert "success with the paper, 4 models" in of_paper
    assert "twin accuracy with nanoMME-16, 5 models and 1 task: -1.00" in twins
    assert agreements([row for row in rows if row["model"] in order[:2]]) == []


def test_the_published_table_is_of_its_records_and_the_page_prints_its_correlations() -> None:
    folder = published_folder("mikasa24")
    rows = measure(arguments(folder, tasks=list(TASKS), models=list(MODELS)), Commands(stop=0))
    assert len(rows) == 24 * 7 * 2, "nothing is measured again"
    for model in MODELS:
        for seed in "01":
            folders = folder / "evaluation" / model / seed
            records = read_folders(sorted(folders.rglob("*.jsonl")))
            counts = Counter(record.task for record in records if record.success)
            solved = {
                row["task"]: int(row["successes"])
                for row in rows
                if (row["model"], row["seed"]) == (model, seed)
            }
            assert len(records) == 240 and solved == {task: counts[task] for task in TASKS}
    page = (REPOSITORY / "docs" / "evidence" / "mikasa.md").read_text()
    for sentence in agreements(rows):
        value, low, high = re.findall(r"-?\d\.\d\d", sentence)
        assert f"{value} ({low} to {high})" in page


@pytest.mark.parametrize("stop", [1, 2, 3, 4, 6, 8])
def test_an_interrupted_run_goes_on(tmp_path: Path, stop: int) -> None:
    commands = Commands(stop)
    with pytest.raises(KeyboardInterrupt):
        measure(arguments(tmp_path), commands)
    continued = Commands()
    rows = measure(arguments(tmp_path), continued)
    assert len({(row["model"], row["seed"], row["task"]) for row in rows}) == len(rows) == 8
    done = commands.done + continued.done
    assert (done.count("record"), done.count("train"), done.count("analyse")) == (2, 4, 1)


def test_a_row_that_is_missing_is_made_again(tmp_path: Path) -> None:
    measure(arguments(tmp_path), Commands())
    path = tmp_path / "table.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]))
    commands = Commands()
    assert len(measure(arguments(tmp_path), commands)) == 8
    assert commands.done == ["evaluate", "evaluate", "probe"], "which continue, and repeat nothing"


def test_names_that_do_not_exist_are_refused_before_anything_runs(tmp_path: Path) -> None:
    commands = Commands()
    for more in ({"tasks": ["RememberColour3"]}, {"models": ["framesamp"]}):
        with pytest.raises(UserError, match=r"'RememberColour3'|'framesamp'"):
            measure(arguments(tmp_path, **more), commands)
    assert commands.done == []


def test_the_choice_of_tasks_has_every_kind_of_memory_that_runs() -> None:
    kinds = {FAMILY_OF[task].memory for task in TASKS}
    assert len(set(TASKS)) == 24
    assert kinds == {family.memory for family in FAMILY_OF.values() if not family.needs}
    longer = [task for task in TASKS if STEPS[task] > MOST_STEPS]
    assert {FAMILY_OF[task].memory for task in longer} == {"Capacity", "Sequential"}
    assert set(TASKS) <= set(environment(mikasa_table.ENV).tasks)


def test_each_model_is_composed_with_its_settings() -> None:
    assert set(SELECTING) < set(MODELS)
    for model, words in MODELS.items():
        given = [*mikasa_table.BACKBONE, *words, *mikasa_table.TRAINING]
        cfg = compose("train", [f"model={model}", f"env={mikasa_table.ENV}", *given])
        assert cfg.name == model
