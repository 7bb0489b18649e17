"""Reading official HDF5 files."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from helpers.h5_files import write_file
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import EpisodeRef, find_files, list_episodes, open_episode
from mme_vla.errors import UserError


def test_files_come_sorted_and_episodes_numerically(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Zeta.h5", [4])
    write_file(tmp_path / "record_dataset_Alpha.h5", [4, 4, 4], numbers=[10, 2, 1])
    refs = list_episodes(find_files([tmp_path]))
    assert [(ref.task, ref.index) for ref in refs] == [
        ("Alpha", 1),
        ("Alpha", 2),
        ("Alpha", 10),
        ("Zeta", 0),
    ]


def test_episode_fields_are_decoded(tmp_path: Path) -> None:
    path = tmp_path / "record_dataset_Alpha.h5"
    (recorded,) = write_file(path, [12], videos=[5], numbers=[3])
    with open_episode(EpisodeRef(path, 3, "Alpha")) as episode:
        assert (episode.length, episode.exec_start, episode.seed, episode.difficulty) == (
            12,
            5,
            300,
            "easy",
        )
        assert episode.goals == ["do task 3", "another wording"]
        frames = list(episode)
    assert np.array_equal(np.stack([frame.state for frame in frames]), recorded.state)
    assert np.array_equal(np.stack([frame.action for frame in frames]), recorded.actions)
    assert np.array_equal(np.stack([frame.front for frame in frames]), recorded.front)
    assert [frame.is_demo for frame in frames] == [True] * 5 + [False] * 7
    assert frames[4].subgoals["grounded_subgoal_online"] == "pick up 1 at <1, 2> online"


def test_subgoals_of_a_completed_task_stay_the_last_ones(tmp_path: Path) -> None:
    path = tmp_path / "record_dataset_Alpha.h5"
    write_file(path, [12])
    with open_episode(EpisodeRef(path, 0, "Alpha")) as episode:
        subgoals = [frame.subgoals["simple_subgoal"] for frame in episode]
    assert subgoals[-3:] == ["pick up 2"] * 3


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda e: e.pop("timestep_3"), "without gaps"),
        (lambda e: e["timestep_0"].pop("obs/wrist_rgb"), "lacks timestep_0/obs/wrist_rgb"),
        (
            lambda e: e["timestep_4"].pop("action/joint_action"),
            "timestep_4/action/joint_action is damaged",
        ),
        (
            lambda e: e["timestep_5/info/is_video_demo"].write_direct(np.array(True)),
            "video frames must come first",
        ),
    ],
)
def test_a_damaged_episode_is_named(tmp_path: Path, damage, message: str) -> None:
    path = tmp_path / "record_dataset_Alpha.h5"
    write_file(path, [8])
    with h5py.File(path, "a") as file:
        damage(file["episode_0"])
    with (
        pytest.raises(UserError, match=message),
        open_episode(EpisodeRef(path, 0, "Alpha")) as episode,
    ):
        list(episode)


def replaced(name: str, value: Any) -> Callable[[h5py.Group], None]:
    def replace(episode: h5py.Group) -> None:
        del episode[name]
        episode[name] = value

    return replace


def choice(letter: str, *point: int) -> Callable[[h5py.Group], None]:
    text = json.dumps({"choice": letter, "point": point})
    return replaced("timestep_4/action/choice_action", text)


NAN, FAR = np.array([np.nan, *range(6)]), np.array([1e39, *[0.5] * 7])
WAYPOINT = "timestep_8/action/waypoint_action"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (replaced("setup/task_goal", np.array([0.0])), "setup/task_goal is damaged.*a text is exp"),
        (replaced("setup/task_goal", ""), "setup/task_goal is empty"),
        (replaced("setup/difficulty", 3), "setup/difficulty is damaged.*a text is expected"),
        (replaced("setup/task_goal", ["lift it", "a\x1b[31m"]), "setup/task_goal .* control char"),
        (replaced("timestep_5/action/joint_action", FAR), "timestep_5/.* of sizes up to"),
        (
            replaced("timestep_5/action/joint_action", np.zeros(9)),
            "timestep_5/.*; expected 8",
        ),
        (replaced("timestep_5/action/joint_action", np.full(8, 2.0)), "command from −1 to 1"),
        (replaced("timestep_5/obs/joint_state", np.full(7, 90.0)), "timestep_5/.*radians"),
        (replaced("timestep_5/obs/joint_state", np.full(7, 1)), "timestep_5/.*floating-point"),
        (replaced("timestep_5/obs/gripper_state", np.full(2, 40.0)), "timestep_5/.*metres"),
        (replaced("timestep_5/obs/eef_state", np.zeros(7)), "timestep_5/.*; expected 6 floating"),
        (
            replaced("timestep_0/action/waypoint_action", np.full(8, np.nan)),
            "; expected 7",
        ),
        (
            replaced("timestep_0/action/eef_action", np.full(7, np.nan)),
            "timestep_0/.*eef_action",
        ),
        (
            replaced("timestep_5/action/eef_action", np.full(7, 0.0)),
            "timestep_5/action/eef_action commands 0.0 to the gripper, and joint_action .* 1.0",
        ),
        (
            replaced("timestep_5/info/is_completed", 7),
            "timestep_5/.*a flag, false or true",
        ),
        (replaced(WAYPOINT, NAN), "timestep_8/action/waypoint_action .*or NaN alone"),
        (replaced(WAYPOINT, np.full(7, np.inf)), "timestep_8/action/waypoint_action .*inf"),
        (replaced(WAYPOINT, np.full(7, np.nan)), "timestep_8/.* NaN after a step that has a pose"),
        (choice("H"), "timestep_4/action/choice_action: .* chooses 'h', but the episode offers a"),
        (choice("A"), "timestep_4/action/choice_action: .* no point, which the option 'a' needs"),
        (choice("A", -4, 9999), "timestep_4/action/choice_action: .* and pixels to 256"),
        (
            replaced("timestep_5/obs/wrist_rgb", np.zeros((4, 4, 3), np.uint8)),
            r"'wrist' at step 5 is \[4, 4, 3\], the one read first \[16, 16, 3\]",
        ),
    ],
)
def test_values_that_cannot_be_are_named_before_they_are_converted(
    tmp_path: Path, damage: Callable[[h5py.Group], None], message: str
) -> None:
    path = tmp_path / "record_dataset_Alpha.h5"
    write_file(path, [12], videos=[4], poses=True, choices=True)
    with h5py.File(path, "r+") as file:
        damage(file["episode_0"])
    with pytest.raises(UserError, match=message):
        convert(list_episodes([path]), tmp_path / "data", ConvertOptions(images="png"))


def test_an_episode_of_one_step_is_converted(tmp_path: Path) -> None:
    path = tmp_path / "record_dataset_Alpha.h5"
    write_file(path, [1], poses=True)
    assert convert(list_episodes([path]), tmp_path / "data", ConvertOptions(images="png")) == 1


def test_an_image_that_was_not_rendered_is_named_whatever_the_choice_of_frames_says(
    tmp_path: Path,
) -> None:
    path = tmp_path / "record_dataset_Alpha.h5"
    write_file(path, [12])
    with h5py.File(path, "r+") as file:
        file["episode_0/setup/frames"] = "{}"
        del file["episode_0/timestep_7/obs/front_rgb"]
    with (
        open_episode(EpisodeRef(path, 0, "Alpha")) as episode,
        pytest.raises(UserError, match="front was not rendered at step 7"),
    ):
        episode.front(7)


def test_episodes_that_one_dataset_cannot_hold_are_refused_before_any_is_converted(
    tmp_path: Path,
) -> None:
    for name, size in (("Alpha", 16), ("Beta", 32)):
        write_file(tmp_path / f"record_dataset_{name}.h5", [12], size=size)
    refs = list_episodes(find_files([tmp_path]))
    with pytest.raises(UserError, match=r"Beta.h5 episode_0 has images \[32, 32, 3\], .*Alpha.h5"):
        convert(refs, tmp_path / "data")
    (tmp_path / "copy").mkdir()
    copy = tmp_path / "copy" / refs[0].file.name
    shutil.copy(refs[0].file, copy)
    with pytest.raises(UserError, match=r"are copies of one file: episode_0 would be .* twice"):
        convert([refs[0], *list_episodes([copy])], tmp_path / "data")
    assert not (tmp_path / "data").exists()


def test_what_is_no_demonstration_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.h5").write_bytes(b"not HDF5")
    with pytest.raises(UserError, match="cannot be read as HDF5"):
        list_episodes([tmp_path / "a.h5"])
    h5py.File(tmp_path / "b.h5", "w").close()
    with pytest.raises(UserError, match="no episode_<number> group"):
        list_episodes([tmp_path / "b.h5"])
    with pytest.raises(UserError, match="No HDF5 file at"):
        find_files([tmp_path / "missing"])


def test_a_folder_that_is_a_dataset_already_is_called_so(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    with pytest.raises(UserError, match=r"LeRobot dataset already.*hdf5="):
        find_files([tmp_path])


def test_official_files_are_read(h5_folder: Path) -> None:
    episodes = {}
    for ref in list_episodes(find_files([h5_folder])):
        with open_episode(ref) as episode:
            frame = next(iter(episode))
            assert (
                frame.front.shape == frame.wrist.shape == (256, 256, 3)
                and frame.front.dtype == np.uint8
            )
            assert frame.state.shape == frame.action.shape == (8,)
            episodes[ref.task, ref.index] = (episode.length, episode.exec_start, episode.difficulty)
    assert episodes == {
        ("PatternLock", 8): (148, 74, "easy"),
        ("PickXtimes", 8): (332, 0, "easy"),
        ("VideoUnmask", 4): (263, 66, "easy"),
    }
