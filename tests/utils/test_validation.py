"""Checks of what comes from outside: the first mistake, as one sentence with key, value and
what is allowed.
"""

from typing import Annotated, Any, Literal

import numpy as np
import pytest
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictInt

from mme_vla.errors import UserError
from mme_vla.utils.validation import described, validated


def even(value: int) -> int:
    if value % 2:
        raise ValueError("must be an even number")
    return value


class Inner(BaseModel):
    width: StrictInt


class Outer(BaseModel):
    model_config = ConfigDict(extra="forbid")
    steps: Annotated[StrictInt, Field(ge=0)] = 0
    kind: Literal["simple", "grounded"] = "simple"
    count: Annotated[int, AfterValidator(even)] = 0
    inners: list[Inner] = []
    some: Annotated[list[int], Field(min_length=1)] = [1]
    few: Annotated[list[int], Field(min_length=1, max_length=2)] = [1]
    short: Annotated[str, Field(max_length=3)] = ""
    name: str = Field(alias="the/name", description="what it is called")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": "x"}, "steps='x' must be a whole number, 0 or more."),
        ({"steps": -1}, "steps=-1 must be a whole number, 0 or more."),
        ({"kind": "grounde"}, "kind='grounde'. Did you mean 'grounded'? Known: grounded, simple."),
        ({"kind": 3}, "kind=3 must be simple or grounded."),
        ({"count": 3}, "count must be an even number, got 3."),
        ({"inners": [{"width": 1}, {"width": None}]}, "inners[1].width=None must be a whole"),
        ({"inners": [{}]}, "inners[0] lacks the key 'width'; it has none."),
        ({"some": []}, "some=[] must be a list of 1 or more values, each a whole number."),
        ({"few": [1, 2, 3]}, "few=[1, 2, 3] must be a list of 1 to 2 values, each a whole"),
        ({"short": "long"}, "short='long' must be a text of length 3 or less."),
        ({"stepz": 1}, "Unknown key stepz. Did you mean 'steps'?"),
        ({"the/name": 3}, "the/name=3 must be a text."),
    ],
)
def test_a_mistake_names_key_value_and_what_is_allowed(
    change: dict[str, Any], message: str
) -> None:
    right = {"the/name": "a"}
    assert validated(Outer, right, "The file").name == "a"
    with pytest.raises(UserError) as raised:
        validated(Outer, right | change, "The file")
    assert str(raised.value).startswith(message)


def test_a_missing_key_is_named_with_its_meaning() -> None:
    with pytest.raises(
        UserError, match=r"The file lacks the key 'the/name' \(what it is called\); it has"
    ):
        validated(Outer, {"steps": 1}, "The file")


def test_large_values_are_described_in_short() -> None:
    assert described(np.zeros((2, 3), np.uint8)) == "uint8 [2, 3]"
    nested: Any = []
    for _ in range(5000):
        nested = [nested]
    assert described(nested) == "a list of 1 value, the first: a list"
    assert len(described("x" * 10_000)) < 100
