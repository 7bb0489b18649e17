"""The robot as a part: its YAML, what it refuses, what old checkpoints mean, and what its numbers
become.
"""

import json
import math
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import torch
from omegaconf import OmegaConf

from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.config.composition import compose
from mme_vla.config.trees import library_files
from mme_vla.data.frame_tables import check_vectors
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.embodiment.robomme import check_benchmark, embodiment_of
from mme_vla.policy.saving import composition_digest
from mme_vla.processing.processor import Processor
from mme_vla.testing.small import SMALL_VISION, unit_stats
from mme_vla.utils import SUMS

SHIPPED = list(library_files("embodiment"))
SPACES = ("joint_angle", "ee_pose", "waypoint", "multi_choice")
TINY = {"vision": {**SMALL_VISION, "patch_size": 16}}


def shipped(name: str) -> Embodiment:
    section: Any = OmegaConf.to_container(
        compose("policy", [f"embodiment={name}"]).embodiment, resolve=True
    )
    return Embodiment.from_dict(section)


def section(**changes: Any) -> dict[str, Any]:
    return {**ROBOMME_JOINT.to_dict(), **changes}


def action(**changes: Any) -> dict[str, Any]:
    return section(action={**ROBOMME_JOINT.action.to_dict(), **changes})


def test_the_default_yaml_is_the_robot_of_python() -> None:
    assert shipped("robomme_joint") == ROBOMME_JOINT
    assert embodiment_of({"embodiment": section()}) == ROBOMME_JOINT
    with pytest.raises(UserError, match="embodiment"):
        embodiment_of({})


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_robot_survives_json_and_builds_a_policy(name: str) -> None:
    robot = shipped(name)
    assert robot.name == name
    assert Embodiment.from_dict(json.loads(json.dumps(robot.to_dict()))) == robot
    policy = build_policy("pi05", device="meta", embodiment=name)
    assert policy.embodiment == robot and policy.backbone.config.horizon == robot.action.horizon
    if name.startswith("robomme"):
        check_benchmark(robot, SPACES)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (section(cameras={}), "at least one camera"),
        (section(cameras={"front": {"augmnt": "all"}}), "Did you mean 'augment'"),
        (section(cameras={"front": {"augment": "color"}}), "Did you mean 'colour'"),
        (section(cameras={"state": {}}), "call the camera something else"),
        (section(memory_camera="frnt"), "Did you mean 'front'"),
        (section(state={"key": "state"}), "embodiment.state lacks the key 'width'; it has key"),
        (section(fsp=20), "Did you mean 'fps'"),
        (section(fps=0), "fps=0 must be a number above 0 and at most 1000 or null"),
        (section(fps=math.inf), "fps=inf must be a number above 0 and at most 1000"),
        (
            section(state={"width": 10**9}),
            "must be a whole number from 1 to 65536",
        ),
        (section(cameras="x" * 10**6), "at least one camera"),
        (action(width=0), "action.width=0 must be a whole number from 1 to"),
        (action(relative=[8]), "relative must list numbers from 0 to 7"),
        (action(relative=[1, 1]), "twice"),
        (action(relative=7.5), "relative.*7.5 must be a whole number"),
        (action(angles={"roll": 3.1}), r"angles.roll='roll' must be a valid integer\.$"),
        (action(angles={3: "x"}), r"angles\[3\]='x' must be a number\.$"),
        (action(angles={9: 3.1}), "angles must list numbers from 0 to 7"),
        (action(names=["x"]), "names must hold 8 texts"),
        (action(execute=21), "a chunk has 20 actions"),
        (action(frames=2), "expected 1; null if"),
    ],
)
def test_impossible_robots_are_refused_by_the_key_in_few_words(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message) as caught:
        Embodiment.from_dict(options)
    assert len(str(caught.value)) < 300


def test_a_robot_and_a_network_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UserError, match=r"8 numbers an action.*action_dim=4"):
        build_policy("pi05", device="meta", backbone={"action_dim": 4})
    with pytest.raises(UserError, match=r"embodiment.action.horizon=20 and backbone.horizon=5"):
        build_policy("pi05", device="meta", backbone={"horizon": 5})


def saved(folder: Path) -> MMEPolicy:
    """A policy of the default robot; its files may be changed."""
    policy = build_policy("pi05", backbone=TINY)
    policy.require_processor().stats = unit_stats()
    policy.save_pretrained(folder)
    (folder / SUMS).unlink()
    return policy


def test_a_processor_of_another_robot_than_the_configurations_is_refused(tmp_path: Path) -> None:
    saved(tmp_path)
    file = tmp_path / "processor.json"
    settings = json.loads(file.read_text())
    settings["embodiment"]["action"]["relative"] = []
    file.write_text(json.dumps(settings))
    with pytest.raises(UserError, match="they describe it differently"):
        MMEPolicy.from_pretrained(tmp_path)


def test_a_checkpoint_without_its_robot_is_refused(tmp_path: Path) -> None:
    saved(tmp_path)
    for name in ("config.json", "processor.json"):
        settings = json.loads((tmp_path / name).read_text())
        del settings["embodiment"]
        (tmp_path / name).write_text(json.dumps(settings))
        with pytest.raises(UserError, match="embodiment"):
            MMEPolicy.from_pretrained(tmp_path)
        (tmp_path / name).write_text(json.dumps({**settings, "embodiment": section()}))


def test_a_checkpoint_keeps_its_robot(tmp_path: Path) -> None:
    policy = build_policy("pi05", backbone=TINY, embodiment="robomme_waypoint")
    policy.save_pretrained(tmp_path)
    assert MMEPolicy.from_pretrained(tmp_path).embodiment == shipped("robomme_waypoint")
    assert Processor.load(tmp_path).embodiment.action.horizon == 4


def test_the_robot_tells_compositions_apart() -> None:
    config: dict[str, Any] = {"memory": None, "backbone": {"horizon": 20}}
    digest = composition_digest({**config, "embodiment": section()})
    assert composition_digest({**config, "embodiment": action(relative=[])}) != digest


def test_statistics_of_another_robot_are_refused() -> None:
    policy = build_policy("pi05", backbone=TINY, embodiment="robomme_ee_pose")
    with pytest.raises(UserError, match="are not those of 'robomme_ee_pose'"):
        policy.require_processor().stats = unit_stats()


def test_absolute_actions_stay_as_they_are_recorded() -> None:
    space = shipped("robomme_joint_absolute").action
    actions, state = torch.randn(3, 20, 8), torch.randn(3, 8)
    assert torch.equal(space.to_relative(actions, state), actions)


def test_angles_do_not_jump_and_the_gripper_of_a_waypoint_is_exactly_open_or_closed() -> None:
    space = shipped("robomme_waypoint").action
    recorded = torch.tensor(
        [
            [0.1, 0.2, 0.3, math.pi - 0.01, 0.0, -0.1, -1.0],
            [0.1, 0.2, 0.3, 0.01 - math.pi, 0.0, 0.1, 1.0],
        ]
    )
    predicted = space.to_relative(recorded[None], torch.zeros(1, 8))[0]
    assert torch.allclose(
        predicted[:, 3], torch.tensor([math.pi - 0.01, math.pi + 0.01]), atol=1e-5
    )
    assert torch.allclose(
        predicted[:, [0, 1, 2, 4, 5, 6]], recorded[:, [0, 1, 2, 4, 5, 6]], atol=1e-6
    )
    noisy = predicted + 0.3
    assert space.to_absolute(noisy[None], torch.zeros(1, 8))[0, :, 6].tolist() == [-1.0, 1.0]


def test_robots_that_the_benchmark_does_not_have_are_not_evaluated_on_it() -> None:
    with pytest.raises(UserError, match="its action space is None"):
        check_benchmark(shipped("real_panda"), SPACES)
    with pytest.raises(UserError, match="has the cameras side"):
        check_benchmark(Embodiment.from_dict(section(cameras={"front": {}, "side": {}})), SPACES)


def test_a_single_number_may_stand_without_a_list_and_is_checked_all_the_same(
    tmp_path: Path,
) -> None:
    class Table:
        def __init__(self, *values: float | None) -> None:
            self.data = {"gripper": pa.chunked_array([pa.array(values, pa.float32())])}

    check_vectors(tmp_path, Table(0.5, 1.0), "gripper", 1)
    for wrong in (None, math.nan, math.inf):
        with pytest.raises(UserError, match="row 1 has gripper"):
            check_vectors(tmp_path, Table(0.5, wrong), "gripper", 1)


def named(**changes: Any) -> Embodiment:
    names = [*(f"joint {i}" for i in range(1, 8)), "gripper"]
    return Embodiment.from_dict({**action(names=names), "fps": 30.0, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            action(names=["gripper", *(f"joint {i}" for i in range(1, 8))]),
            "same names in another order",
        ),
        ({"state": {"width": 9}}, r"8 numbers of state.* does not fit .*9 numbers of state"),
        ({"cameras": {"front": None}}, "with the cameras front, wrist,.*has the cameras front, 8"),
    ],
)
def test_a_policy_acts_only_where_the_robot_has_its_cameras_and_numbers(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        named().check_place(named(**changes))


def test_another_rate_of_the_environment_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    named().check_place(named())
    named().check_place(named(fps=None))
    assert not caplog.records
    named().check_place(named(fps=10.0))
    assert "has 30 frames per second, the environment's robomme_joint has 10" in caplog.text
