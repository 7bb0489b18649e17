"""What files say of a robot: contradictions between them are told, and compositions of two robots are kept apart."""

import json
import math
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.data.lerobot_files import check_vectors
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.policy.saving import composition_digest
from mme_vla.testing.small import SMALL_VISION, unit_stats
from mme_vla.utils import SUMS

TINY = {"vision": {**SMALL_VISION, "patch_size": 16}}


def test_a_processor_of_another_robot_than_the_configurations_is_refused(tmp_path: Path) -> None:
    policy = build_policy("pi05", backbone=TINY)
    policy.require_processor().stats = unit_stats()
    policy.save_pretrained(tmp_path)
    (tmp_path / SUMS).unlink()
    assert MMEPolicy.from_pretrained(tmp_path).embodiment == ROBOMME_JOINT
    file = tmp_path / "processor.json"
    settings = json.loads(file.read_text())
    settings["embodiment"]["action"]["relative"] = []
    file.write_text(json.dumps(settings))
    with pytest.raises(UserError, match="they describe it differently"):
        MMEPolicy.from_pretrained(tmp_path)


def test_the_robot_tells_compositions_apart_and_the_panda_goes_without_saying() -> None:
    config: dict[str, Any] = {"memory": None, "backbone": {"horizon": 20}}
    digest = composition_digest(config)
    assert composition_digest({**config, "embodiment": ROBOMME_JOINT.to_dict()}) == digest
    absolute = {**ROBOMME_JOINT.to_dict(), "action": {**ROBOMME_JOINT.action.to_dict(), "relative": []}}
    assert composition_digest({**config, "embodiment": absolute}) != digest


def test_a_single_number_may_stand_without_a_list_and_is_checked_all_the_same(tmp_path: Path) -> None:
    class Table:
        def __init__(self, *values: float | None) -> None:
            self.data = {"gripper": pa.chunked_array([pa.array(values, pa.float32())])}

    check_vectors(tmp_path, Table(0.5, 1.0), "gripper", 1)
    for wrong in (None, math.nan, math.inf):
        with pytest.raises(UserError, match="row 1 has gripper"):
            check_vectors(tmp_path, Table(0.5, wrong), "gripper", 1)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("fps", math.inf, "positive number to 1000"),
        ("state", {"width": 10**9}, "positive whole number to 65536"),
        ("cameras", "x" * 10**6, "at least one camera"),
    ],
)
def test_impossible_sizes_are_refused_in_few_words(key: str, value: Any, message: str) -> None:
    with pytest.raises(UserError, match=message) as caught:
        Embodiment.from_dict({**ROBOMME_JOINT.to_dict(), key: value})
    assert len(str(caught.value)) < 300
