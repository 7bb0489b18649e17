"""The YAML file of an unknown robot, drafted from its dataset."""

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from mme_vla.data.lerobot_files import Info, find_columns
from mme_vla.data.robot_draft import CHECK, RobotDraft, draft_robot, save_draft
from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError

IMAGE = {"dtype": "video", "shape": [120, 160, 3]}


def vector(*names: str, width: int = 0) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [width or len(names)], "names": list(names) or None}


def info_of(fps: float = 15, **features: Any) -> Info:
    columns = {name.replace("__", "."): value for name, value in features.items()}
    return Info.model_validate({"features": columns, "fps": fps})


def drafted(info: Info, folder: str = "My Robot-2", taken: tuple[str, ...] = ()) -> RobotDraft:
    draft = draft_robot(Path(folder), info, taken)
    assert draft is not None
    return draft


def robot_of(draft: RobotDraft) -> Embodiment:
    section: Any = OmegaConf.to_container(OmegaConf.create(draft.text), resolve=True)
    return Embodiment.from_dict(section)


def test_cameras_widths_names_and_rate_are_the_datasets() -> None:
    info = info_of(
        observation__images__ceiling=IMAGE,
        observation__images__wrist=IMAGE,
        observation__state=vector("j1", "j2", "gripper", "extra"),
        action=vector("j1", "j2", "gripper"),
        timestamp=vector(width=1),
    )
    draft = drafted(info)
    robot = robot_of(draft)
    assert draft.name == robot.name == "my_robot_2"
    assert robot.camera_names == ("ceiling", "wrist") and robot.memory_camera == "ceiling"
    assert [camera.augment for camera in robot.cameras] == ["all", "colour"]
    assert (robot.state.width, robot.action.width, robot.fps) == (4, 3, 15)
    assert robot.action.names == ("j1", "j2", "gripper")
    assert robot.action.relative == (0, 1), "a gripper stays absolute"
    assert not robot.conditioning_video
    find_columns(Path("data"), info.features, robot)


@pytest.mark.parametrize("fps", [15.0, 12.5, 30000 / 1001])
def test_the_rate_is_the_datasets_to_the_last_digit(fps: float) -> None:
    info = info_of(fps, observation__images__top=IMAGE, state=vector("x"), action=vector("x"))
    assert robot_of(drafted(info)).fps == fps


def test_guesses_are_marked() -> None:
    draft = drafted(info_of(top=IMAGE, observation__state=vector(width=2), action=vector(width=2)))
    marked = [line.partition(":")[0] for line in draft.open_lines]
    assert marked == ["augment", "memory_camera", "relative", "horizon", "execute"]
    assert draft.text.count(f"# {CHECK}") == len(marked)
    assert robot_of(draft).action.relative == (), "nothing says that state and action are alike"


def test_unusual_columns_are_named() -> None:
    info = info_of(
        images__head=IMAGE,
        state=IMAGE,
        observation__arm=vector(width=2),
        observation__hand=vector(width=1),
        action__arm=vector(width=2),
        action__hand=vector(width=1),
        is_demo={"dtype": "bool", "shape": [1]},
    )
    robot = robot_of(drafted(info))
    assert robot.state.key == ("observation.arm", "observation.hand")
    assert robot.action.key == ("action.arm", "action.hand")
    assert "state" not in robot.camera_names, "messages have the state under this name"
    assert robot.conditioning_video
    columns = find_columns(Path("data"), info.features, robot)
    assert set(columns.cameras.values()) == {"images.head", "state"}


def test_a_gripper_of_whole_numbers_or_flags_is_among_the_joined_columns() -> None:
    single = {"shape": [1], "names": None}
    info = info_of(
        **{
            "observation.images.top": IMAGE,
            "observation.state.arm": vector(width=6),
            "observation.state.gripper": {"dtype": "uint8", **single},
            "action.arm": vector(width=6),
            "action.gripper": {"dtype": "bool", **single},
        }
    )
    draft = drafted(info)
    robot = robot_of(draft)
    assert robot.state.key == ("observation.state.arm", "observation.state.gripper")
    assert robot.action.key == ("action.arm", "action.gripper") and robot.action.width == 7
    assert sum(line.startswith("key:") for line in draft.open_lines) == 2


def test_a_folder_with_the_name_of_a_value_gives_a_name() -> None:
    info = info_of(top=IMAGE, observation__state=vector(width=2), action=vector(width=2))
    for folder in ("null", "True"):
        draft = drafted(info, folder)
        assert draft.name == robot_of(draft).name == f"own_{folder.lower()}"


def test_depth_is_no_camera() -> None:
    depth = {**IMAGE, "info": {"video.is_depth_map": True}}
    info = info_of(
        top=IMAGE, top_depth=depth, observation__state=vector(width=2), action=vector(width=2)
    )
    assert robot_of(drafted(info)).camera_names == ("top",)


def test_names_stay_texts_whatever_they_hold() -> None:
    names = ("yes", "${oc.env:HOME}", "a: b # c", "line\nbreak")
    info = info_of(top=IMAGE, observation__state=vector(width=4), action=vector(*names))
    assert robot_of(drafted(info)).action.names == names


def test_name_of_another_robot_is_not_taken() -> None:
    info = info_of(top=IMAGE, observation__state=vector(width=2), action=vector(width=2))
    assert drafted(info, "real_panda", ("real_panda",)).name == "own_real_panda"
    assert drafted(info, "2024").name == "own_2024"


def test_without_images_or_actions_there_is_no_draft() -> None:
    """The message names what is absent, and not the command that drafts, which the reader ran."""
    with pytest.raises(UserError, match="no column of a camera and none of an action") as error:
        draft_robot(Path("data"), info_of(observation__state=vector(width=2)))
    assert "mme-vla inspect" not in str(error.value)
    with pytest.raises(UserError, match="no column of a state,"):
        draft_robot(Path("data"), info_of(top=IMAGE, action=vector(width=2)))


def test_existing_file_stays(tmp_path: Path) -> None:
    info = info_of(top=IMAGE, observation__state=vector(width=2), action=vector(width=2))
    draft = drafted(info)
    path, is_new = save_draft(draft, tmp_path)
    assert is_new and path.read_text() == draft.text
    path.write_text("name: mine\n")
    assert save_draft(draft, tmp_path) == (path, False)
    assert path.read_text() == "name: mine\n"
