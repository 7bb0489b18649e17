"""Training data of the subgoal predictors: row by row as released, with its defects repaired or
kept as asked.
"""

import json
import shutil
import zipfile
from collections import Counter

import numpy as np
import pytest

from helpers import REPOSITORY
from mme_vla.cli import subgoal_build
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.errors import UserError
from mme_vla.subgoal.clips import Clip, read_image, sample_video
from mme_vla.subgoal.finetuning import collecting as module
from mme_vla.subgoal.finetuning.collecting import build, open_input
from mme_vla.subgoal.finetuning.labels import (
    Labels,
    keyframes,
    resting_frames,
    selected_steps,
    transitions,
    windows,
)
from mme_vla.subgoal.finetuning.rows import RowOptions, episode_rows
from mme_vla.subgoal.finetuning.training import write_arguments
from mme_vla.utils import SUMS

SETS = {
    "simple": "qwenvl_simple_subgoal",
    "grounded": "qwenvl_grounded_subgoal",
    "memer": "memer_grounded_subgoal",
    "memer_simple": "memer_simple_subgoal",
}
RELEASED = RowOptions(noise=None, repeat_changes=False, second_keyframe=False, substring_match=True)


@pytest.fixture(scope="module")
def golden(parity):
    return json.loads((parity / "pipeline_datasets.json").read_text().replace("OUT/", ""))


@pytest.fixture(scope="module")
def h5(parity, tmp_path_factory):
    folder = tmp_path_factory.mktemp("h5")
    with zipfile.ZipFile(parity / "pipeline_h5.zip") as archive:
        archive.extractall(folder)
    return folder


@pytest.fixture(scope="module")
def labelled(h5):
    """All episodes and their labels, which tests only read."""
    return [(episode, episode.labels()) for episode in open_input(h5)]


@pytest.fixture(scope="module")
def built(h5, tmp_path_factory):
    output = tmp_path_factory.mktemp("built") / "data"
    build(open_input(h5), output, list(SETS), RELEASED)
    return output


def rows_of(folder, name):
    return [json.loads(line) for line in (folder / f"{name}.jsonl").read_text().splitlines()]


def made_up(task="BinFill", length=64, changes=(0, 20, 40), exec_start=0, number=0):
    """An episode whose subgoal is called after the change it began at."""
    names = [f"do {max(c for c in (0, *changes) if c <= t)}" for t in range(length)]
    joints = np.zeros((length, 7))
    points = [f"{name} at <10, 250>" for name in names]
    return Labels(task, number, "a goal", exec_start, list(names), points, joints, joints + 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_sets_equal_the_released_ones_row_by_row(built, golden, name):
    assert rows_of(built, name) == golden["vlm_datasets"][SETS[name]]


@pytest.mark.parametrize("name", SETS)
def test_the_repaired_defects_leave_these_episodes_as_they_are_but_for_the_repeated_rows(
    labelled, golden, name
):
    actual, expected = [], []
    for _, labels in labelled:
        actual += episode_rows(name, labels, RowOptions(noise=None)).rows
    repeats = {
        f"qwenvl/images/{task}_ep{number}_step{step}.png": count
        for task, episodes in golden["qwen_selection"].items()
        for number, one in enumerate(episodes)
        for step, count in one["duplicates"].items()
    }
    for row in golden["vlm_datasets"][SETS[name]]:
        expected += [row] * (1 + repeats.get(row["images"][0], 0))
    assert actual == expected
    assert name.startswith("memer") or len(actual) > len(golden["vlm_datasets"][SETS[name]])


def test_selected_steps_and_repeats_equal_the_released_ones(labelled, golden):
    for episode, labels in labelled:
        expected = golden["qwen_selection"][episode.task][episode.number]
        steps, repeats = selected_steps(labels)
        assert transitions(labels) == expected["transitions"]
        assert steps == expected["selected"]
        assert {str(step): count for step, count in repeats.items()} == expected["duplicates"]


def test_every_image_and_video_a_row_names_is_there(built, labelled):
    labels = {episode.name: (episode, its) for episode, its in labelled}
    for name in SETS:
        for row in rows_of(built, name):
            marks = row["messages"][1]["content"]
            assert marks.count("<image>") == len(row["images"]) and marks.count("<video>") == len(
                row.get("videos", [])
            )
            assert all(
                (built / path).is_file() for path in [*row["images"], *row.get("videos", [])]
            )
    episode, about = labels["VideoRepick_ep0"]
    stored = read_image(built / "qwenvl/images/VideoRepick_ep0_step56.png")
    assert np.array_equal(stored, next(episode.read_images([56])))
    assert (
        Clip.read(built / "memer/images/VideoRepick_ep0_video.mp4").length == about.exec_start == 37
    )


@pytest.mark.slow
def test_a_lerobot_dataset_gives_the_same_rows(h5, golden, tmp_path):
    refs = [
        ref
        for ref in list_episodes(find_files([h5]))
        if ref.task in ("VideoRepick", "PickHighlight")
    ]
    convert(refs, tmp_path / "dataset", ConvertOptions(images="png"))
    build(open_input(tmp_path / "dataset"), tmp_path / "data", ["grounded", "memer"], RELEASED)
    for name in ("grounded", "memer"):
        expected = [
            r
            for r in golden["vlm_datasets"][SETS[name]]
            if "VideoRepick" in str(r) or "PickH" in str(r)
        ]
        assert rows_of(tmp_path / "data", name) == expected


@pytest.mark.slow
def test_an_interrupted_build_continues_and_ends_the_same(h5, built, tmp_path, monkeypatch):
    episodes, output = open_input(h5), tmp_path / "data"
    names, original = [], module._build_episode

    def interrupted(episode, *arguments):
        if len(names) == 2:
            raise KeyboardInterrupt
        original(episode, *arguments)
        names.append(episode.name)

    monkeypatch.setattr(module, "_build_episode", interrupted)
    with pytest.raises(KeyboardInterrupt):
        build(episodes, output, list(SETS), RELEASED)
    monkeypatch.setattr(
        module,
        "_build_episode",
        lambda e, *arguments: (names.append(e.name), original(e, *arguments)),
    )
    build(episodes, output, list(SETS), RELEASED)
    assert Counter(names) == Counter(e.name for e in episodes), "no episode is built twice"
    files = sorted(p.relative_to(built) for p in built.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(output) for p in output.rglob("*") if p.is_file())
    # Encoders may differ in the last bits of such tiny images, and so may the sums of their files;
    # that the videos are there is checked above.
    same = [f for f in files if f.suffix != ".mp4" and f.name != SUMS]
    assert [f for f in same if (built / f).read_bytes() != (output / f).read_bytes()] == []


def test_another_build_is_not_overwritten(built, h5):
    with pytest.raises(UserError, match="other inputs, sets or options"):
        build(open_input(h5), built, ["simple"], RELEASED)
    with pytest.raises(UserError, match="called BinFill_ep0"):
        build([*open_input(h5), *open_input(h5)], built, list(SETS), RELEASED)


def test_a_dataset_that_does_not_tell_its_tasks_is_requested_them(tmp_path):
    from mme_vla.data.lerobot_files import SAMPLE

    copy = shutil.copytree(SAMPLE, tmp_path / "dataset")
    (copy / "meta" / "robomme_episodes.json").unlink()
    with pytest.raises(UserError, match="tasks=<file>"):
        open_input(copy)
    names = {str(e): "PickXtimes" for e in range(4)}
    (tmp_path / "tasks.json").write_text(json.dumps(names))
    assert [episode.name for episode in open_input(copy, tmp_path / "tasks.json")][
        2
    ] == "PickXtimes_ep2"


def test_noise_keeps_to_its_range_and_to_the_image_and_is_sampled_for_each_row():
    labels = made_up(length=2000, changes=(0,))
    rows = episode_rows("grounded", labels, RowOptions()).rows
    points = np.array([point for row in rows for point in row["objects"]["bbox"]])
    assert set(points[:, 0] - 10) == {-2, -1, 0, 1} == set(points[:, 1] - 250)
    assert len({str(row["objects"]["bbox"][0]) for row in rows}) > 4
    edge = made_up(length=2000, changes=(0,))
    edge.grounded[:] = ["at <0, 255>"] * 2000
    clamped = np.array(
        [
            p
            for row in episode_rows("grounded", edge, RowOptions()).rows
            for p in row["objects"]["bbox"]
        ]
    )
    assert clamped[:, 0].min() == 0 and clamped[:, 1].max() == 255
    assert rows == episode_rows("grounded", labels, RowOptions()).rows
    assert rows != episode_rows("grounded", labels, RowOptions(seed=1)).rows


def test_a_second_keyframe_in_one_window_is_detected_unless_the_defect_is_requested():
    labels = made_up(length=80, changes=(0, 20, 28, 50))
    repaired = windows(labels, keyframes(labels))
    assert [w.positions for w in repaired] == [[1], [], [2, 6], [], [1], []]
    assert repaired[-1].past == [0, 20, 28, 50]
    released = windows(labels, keyframes(labels), one_a_window=True)
    assert [w.positions for w in released] == [[1], [], [2], [], [], []], (
        "28 is missed, and 50 with it"
    )


def test_extra_keyframes_belong_to_their_tasks():
    bounds = (0, 30, 60)
    assert keyframes(made_up("ButtonUnmaskSwap", 90, bounds)) == [0, 10, 20, 30, 40, 50, 60]
    assert keyframes(made_up("ButtonUnmask", 90, bounds)) == [0, 30, 60]
    assert keyframes(made_up("ButtonUnmask", 90, bounds), substring_match=True) == [
        0,
        10,
        20,
        30,
        40,
        50,
        60,
    ]
    assert keyframes(made_up("PickHighlight", 90, bounds)) == [0, 15, 30, 60]


def test_the_arm_standing_still_is_a_keyframe_where_the_path_is_the_task():
    labels = made_up("RouteStick", 60, (0,))
    for t in (20, 23, 40):
        labels.targets[t] = labels.joints[t] + 1e-5
    assert resting_frames(labels) == [20, 40], "23 is too near to 20"
    assert keyframes(labels) == [0, 20, 40]
    assert keyframes(made_up("BinFill", 60, (0,))) == [0]


def test_a_short_segment_has_a_row_only_if_requested():
    labels = made_up(length=64, changes=(0, 5, 40))
    assert selected_steps(labels)[0] == [5, 22, 40, 63]
    assert selected_steps(labels, short_segments=True)[0] == [0, 5, 22, 40, 63]


def test_complete_is_no_subgoal():
    labels = Labels(
        "A",
        0,
        "g",
        0,
        ["a", "Complete"],
        ["a at <1, 2>", "complete"],
        np.zeros((2, 7)),
        np.zeros((2, 7)),
    )
    assert labels.simple == ["a", "a"] and labels.grounded == ["a at <1, 2>"] * 2


def test_videos_are_sampled_evenly_and_never_beyond_their_limits():
    assert sample_video(300).tolist() == np.linspace(0, 299, 10).round().tolist()
    assert len(sample_video(66)) == 4 and len(sample_video(105)) == 6 and len(sample_video(3)) == 2
    assert sample_video(1).tolist() == [0]


def test_the_argument_file_of_ms_swift_is_the_papers_recipe(tmp_path):
    options = json.loads(write_arguments(tmp_path, "simple").read_text())
    recipe = [options[key] for key in ("lora_rank", "lora_alpha", "learning_rate", "warmup_ratio")]
    assert recipe == [16, 32, 1e-4, 0.05]
    assert options["per_device_train_batch_size"] * options["gradient_accumulation_steps"] * 4 == 64
    page = (REPOSITORY / "docs" / "train" / "subgoal-training.md").read_text()
    assert f"swift sft {write_arguments(tmp_path, 'grounded').name}\n" in page


@pytest.mark.slow
def test_settings_that_cannot_work_are_named(tmp_path):
    from mme_vla.config.composition import compose

    listed = tmp_path / "list.json"
    listed.write_text("[1]")
    for word, message in (
        ("episodes=2", "episodes=2 must be a list, each a whole number, 0 or more"),
        ("episodes=[a]", r"episodes\[0\]='a' must be a whole number, 0 or more"),
        ("noise=[a,b]", r"noise\[0\]='a' must be a whole number"),
        ("noise=3", "noise=3 must be a list of 2"),
        ("noise=[1,0]", r"noise=\[1, 0\] must be \[lowest, highest\]"),
        ("sets=simple", "sets='simple' must be a list, each simple or grounded"),
        ("sets=[simpel]", r"sets\[0\]='simpel'. Did you mean 'simple'"),
        ("seed=-1", "seed=-1"),
    ):
        with pytest.raises(UserError, match=message):
            subgoal_build.main(
                compose("subgoal_build", ["input=sample", f"output={tmp_path / 'out'}", word])
            )
    for tasks in (tmp_path / "missing.json", tmp_path, listed):
        with pytest.raises(UserError, match="tasks="):
            open_input("sample", tasks)
    assert not (tmp_path / "out").exists()


def test_points_outside_the_image_are_clipped_without_noise_too():
    labels = made_up(length=40, changes=(0,))
    labels.grounded[:] = ["at <-3, 300>"] * 40
    for row in episode_rows("grounded", labels, RowOptions(noise=None)).rows:
        assert {tuple(point) for point in row["objects"]["bbox"]} == {(0, 255)}
