"""The full-size policies map one to one onto the released parameter trees, on the meta device."""

import json
import math
from functools import cache

import pytest

from mme_vla import Policy, build_policy
from mme_vla.weights.released import released_adapter, released_table
from mme_vla.weights.tables import write

VARIANTS = {
    "pi05": "pi05_baseline",
    "pi05_past_actions": "pi05_baseline",
    "simplesg": "symbolic-simple-subgoal",
    "groundsg": "symbolic-grounded-subgoal",
} | {
    f"{memory}_{integration}": f"{kind}-{memory}-{integration}"
    for kind, memory in (
        ("perceptual", "framesamp"),
        ("perceptual", "tokendrop"),
        ("recurrent", "ttt"),
        ("recurrent", "rmt"),
    )
    for integration in ("context", "modul", "expert")
}


@cache
def full_size(variant: str) -> Policy:
    """Shapes alone, which no test changes."""
    return build_policy(variant, backbone="pi05", device="meta")


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_names_and_shapes_equal_the_released_tree(variant: str, shared):
    tree = json.loads((shared / "spec" / f"param_tree_{VARIANTS[variant]}.json").read_text())
    policy = full_size(variant)
    state = policy.state_dict()
    table = released_table(policy)
    assert set(table) == set(state), (
        "every tensor of ours has a released place, and no place is invented"
    )
    adapter = released_adapter(policy)
    exported = write(table, adapter.unread, state, adapter.derived)
    assert {k: tuple(v.shape) for k, v in exported.items()} == {
        k: tuple(v["shape"]) for k, v in tree["params"].items()
    }


@pytest.mark.parametrize("variant", VARIANTS)
def test_parameter_count_is_the_released_one_less_unread_and_derived(variant: str, shared):
    summary = json.loads((shared / "spec" / "param_tree_summary.json").read_text())[
        VARIANTS[variant]
    ]
    policy = full_size(variant)
    adapter = released_adapter(policy)
    unread = sum(math.prod(gap.shape) for gap in adapter.unread)
    derived = sum(constant.make().numel() for constant in adapter.derived)
    assert (
        sum(p.numel() for p in policy.parameters())
        == summary["total_parameters"] - unread - derived
    )
