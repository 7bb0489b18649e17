"""Screw plans equal those of ManiSkill's planner, recorded from `mplib` 0.1.1.

`MME_VLA_PLANS` names another folder with a `screw_plans.json.gz`; by default `../shared/plans` is
used where it exists.
"""

import gzip
import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import sapien

from helpers.env_scenes import Scene
from mme_vla.envs.robomme.robot.kinematics import Arm, matrix_of
from mme_vla.envs.robomme.robot.planning import CONTROL_STEP, goal_in_base, plan_screw

FILE = "screw_plans.json.gz"
LOCAL = Path(__file__).resolve().parents[1] / "data" / FILE
OTHERS = (
    Path(
        os.environ.get("MME_VLA_PLANS") or Path(__file__).resolve().parents[3] / "shared" / "plans"
    )
    / FILE
)


@pytest.fixture(scope="module")
def arm() -> Iterator[Arm]:
    scene = Scene(lambda _: None)
    yield Arm(scene.agent)
    scene.close()


@pytest.mark.parametrize("path", [LOCAL, OTHERS], ids=["kept", "shared"])
def test_screw_plans_equal_the_reference(arm: Arm, path: Path) -> None:
    if not path.is_file():
        pytest.skip(f"no reference plans: {path} is absent (set MME_VLA_PLANS)")
    plans = json.loads(gzip.decompress(path.read_bytes()))
    assert plans
    for plan in plans:
        assert plan["time_step"] == CONTROL_STEP
        arm.base = sapien.Pose(*plan["base"])
        limits = plan["velocity_limit"], plan["acceleration_limit"]
        rows = plan_screw(arm, np.array(plan["qpos"]), sapien.Pose(*plan["target"]), *limits)
        assert rows is not None and rows.shape == np.shape(plan["rows"])
        np.testing.assert_allclose(rows, plan["rows"], rtol=0, atol=1e-12)


def test_poses_keep_double_precision(arm: Arm) -> None:
    joints = np.array([0.1, 0.3, -0.2, -1.9, 0.1, 2.1, 0.6])
    nudged = joints + np.array([1e-10, 0, 0, 0, 0, 0, 0])
    shifted = np.abs(arm.transform(nudged) - arm.transform(joints)).max()
    assert 1e-11 < shifted < 1e-9
    rotation = matrix_of(sapien.Pose([0, 0, 0], [0.5, 0.5, 0.5, 0.5]))[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)


def test_goals_take_the_length_of_quaternions_in_single_precision(arm: Arm) -> None:
    grasp = np.array([0.00250886, 0.99119306, 0.13237302, 0.00056358], np.float32)
    for scale in (1, np.float32(1 + 2e-7)):
        target = sapien.Pose([0, 0, 0.2], grasp * scale)
        single = goal_in_base(arm.base, target, np.float32)
        np.testing.assert_allclose(single[:3, :3] @ single[:3, :3].T, np.eye(3), atol=1e-14)
        assert 0 < np.abs(single - goal_in_base(arm.base, target, np.float64)).max() < 1e-9
