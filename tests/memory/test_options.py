"""Options that a memory gathers in structs are options of its section like any other."""

import pytest

from mme_vla import UserError
from mme_vla.registry import MEMORIES


@pytest.mark.parametrize(
    ("name", "option", "near"),
    [
        ("ttt", "strides", "stride"),
        ("rmt", "position_dims", "position_dim"),
        ("gist", "layer", "layers"),
        ("bank", "fusions", "fusion"),
    ],
)
def test_a_mistyped_option_is_reported_with_the_nearest_name(
    name: str, option: str, near: str
) -> None:
    with pytest.raises(UserError, match=rf"(?s){option}=2.*'{near}'"):
        MEMORIES.build({"name": name, option: 2}, d_vision=32, width=48)


def test_options_of_the_schedule_are_checked() -> None:
    with pytest.raises(UserError, match=r"memory.jitter=8 must be less than half"):
        MEMORIES.build({"name": "ttt", "jitter": 8}, d_vision=32, width=48)
