"""Seeds and difficulties of the benchmark's episodes."""

import csv
import json
from collections import Counter
from pathlib import Path

import pytest

from mme_vla.envs import metadata
from mme_vla.envs.metadata import TASK_NAMES, EpisodeSpec, episode, episodes, formula
from mme_vla.errors import UserError


@pytest.mark.parametrize(("split", "count"), [("train", 1600), ("val", 800), ("test", 800)])
def test_every_split_has_its_number_of_episodes(split: str, count: int) -> None:
    table = [spec for task in TASK_NAMES for spec in episodes(task, split)]
    assert len(table) == count
    assert len({(spec.task, spec.seed) for spec in table}) == count


def test_seeds_follow_the_order_of_tasks_and_episodes() -> None:
    assert episode("PickXtimes", "train", 0).seed == 1000
    assert episode("RouteStick", "train", 0).seed == 16000
    assert episode("StopCube", "val", 2).seed == 1_020_200
    assert episode("RouteStick", "test", 49).seed == 664_900


@pytest.mark.parametrize(
    ("task", "split", "index", "seed", "difficulty"),
    [
        ("ButtonUnmask", "test", 2, 580_201, "medium"),
        ("MoveCube", "train", 68, 20_800, "easy"),
        ("VideoPlaceOrder", "train", 6, 11_603, "medium"),
        ("StopCube", "val", 34, 1_023_500, "hard"),
    ],
)
def test_where_the_official_demonstrator_failed_the_seed_is_the_benchmarks(
    task: str, split: str, index: int, seed: int, difficulty: str
) -> None:
    spec = episode(task, split, index)
    assert (spec.seed, spec.difficulty) == (seed, difficulty)


@pytest.mark.parametrize(
    ("split", "counts"), [("train", (50, 25, 25)), ("val", (26, 12, 12)), ("test", (26, 12, 12))]
)
def test_difficulties_are_distributed_as_the_benchmark_says(
    split: str, counts: tuple[int, int, int]
) -> None:
    n_by_difficulty = Counter(spec.difficulty for spec in episodes("MoveCube", split))
    assert (n_by_difficulty["easy"], n_by_difficulty["medium"], n_by_difficulty["hard"]) == counts


def test_the_first_six_train_episodes_are_recovery_demonstrations() -> None:
    assert [episode("BinFill", "train", index).recovery for index in range(7)] == ["z"] * 3 + [
        "xy"
    ] * 3 + [None]
    assert episode("BinFill", "test", 0).recovery is None


@pytest.mark.parametrize("split", metadata.SPLITS)
def test_the_shipped_table_is_the_published_one(shared: Path, split: str) -> None:
    published = shared / "spec" / "episode_seeds" / f"{split}.csv"
    if not published.is_file():
        pytest.skip(f"no published table at {published}")
    rows = list(csv.DictReader(published.open()))
    assert len(rows) == len(TASK_NAMES) * metadata.SPLITS[split]
    for row in rows:
        index = int(row["episode"])
        expected = EpisodeSpec(row["task"], split, index, int(row["seed"]), row["difficulty"])
        assert episode(row["task"], split, index) == expected


def test_official_episodes_match_the_table(h5_folder: Path) -> None:
    h5py = pytest.importorskip("h5py")
    compared = 0
    for path in h5_folder.glob("record_dataset_*.h5"):
        task = path.stem.removeprefix("record_dataset_")
        with h5py.File(path) as file:
            for name, group in file.items():
                spec = episode(task, "train", int(name.removeprefix("episode_")))
                assert spec.seed == int(group["setup/seed"][()])
                assert spec.difficulty == group["setup/difficulty"][()].decode()
                compared += 1
    assert compared > 0


def test_neither_a_package_nor_a_variable_changes_a_split(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = {"task": "StopCube", "episode": 0, "seed": 520_003, "difficulty": "hard"}
    folder = tmp_path / "robomme" / "env_metadata" / "test"
    folder.mkdir(parents=True)
    (tmp_path / "robomme" / "__init__.py").touch()
    file = folder / "record_dataset_StopCube_metadata.json"
    file.write_text(json.dumps({"records": [record]}))
    expected = episodes("StopCube", "test")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MME_VLA_ROBOMME_METADATA", str(folder.parent))
    assert episodes("StopCube", "test") == expected


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("PickXtime", "test", 0), "PickXtimes"),
        (("PickXtimes", "tset", 0), "'test'"),
        (("PickXtimes", "test", 50), "expected 0 to 49"),
        (("PickXtimes", "test", -1), "expected 0 to 49"),
        (("PickXtimes", "test", True), "expected 0 to 49"),
    ],
)
def test_an_unknown_episode_is_refused(arguments: tuple, words: str) -> None:
    with pytest.raises(UserError, match=words):
        episode(*arguments)


def test_the_formula_gives_seeds_before_retries() -> None:
    assert formula("VideoUnmask", "train", 4) == (6400, "easy")
    assert formula("VideoUnmask", "train", 7) == (6700, "hard")


@pytest.mark.parametrize("split", metadata.SPLITS)
def test_a_seed_lies_close_above_the_formulas_and_has_its_difficulty(split: str) -> None:
    for task in TASK_NAMES:
        for spec in episodes(task, split):
            # In two tasks of `val` later episodes are the formula's next ones, or those after.
            ahead = (spec.seed - formula(task, split, spec.episode)[0]) // 100
            seed, difficulty = formula(task, split, spec.episode + ahead)
            assert 0 <= spec.seed - seed <= 7 and spec.difficulty == difficulty
            assert ahead == 0 or (
                split == "val" and task in ("StopCube", "VideoPlaceButton") and 0 < ahead <= 2
            )


def test_a_task_of_the_users_own_has_no_episodes_in_the_challenge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(metadata, "TASKS", {"Own": None})
    with pytest.raises(UserError, match="the benchmark's tasks alone, and Own is none"):
        episodes("Own", metadata.CHALLENGE)
