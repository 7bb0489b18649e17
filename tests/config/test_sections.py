"""One reader turns a section into its dataclass; every mistake names the key, the value and what
was expected.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import pytest

from mme_vla.config.sections import PathText, Positive, Range, Secret, read_section
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.serving.settings import ServeSettings
from mme_vla.training.settings import TrainSettings


@dataclass(frozen=True)
class Inner:
    width: int
    share: float = 0.5


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner = field(default_factory=lambda: Inner(1))
    other: Inner | None = None
    betas: tuple[float, float] = (0.1, 0.2)
    places: tuple[int, ...] = ()
    fast: bool = False
    limit: int | None = None
    secret: Secret = field(default=None, repr=False)
    anything: Any = None
    port: Annotated[int, Range(0, 9)] | None = None
    seconds: Positive = 1.0
    kind: Literal["simple", "grounded"] | None = None
    output: PathText | None = None
    function: Callable[[float], float] = abs


def test_a_section_becomes_its_dataclass_with_sections_inside_it() -> None:
    options = {
        "name": "a",
        "inner": {"width": 3, "share": 1},
        "other": {"width": 2},
        "betas": [0, 1.0],
        "places": [4, 5],
        "fast": True,
        "limit": None,
        "anything": [{"x": 1}],
    }
    read = read_section(Outer, options, "outer")
    assert read == Outer("a", Inner(3, 1), Inner(2), (0, 1.0), (4, 5), True, None, None, [{"x": 1}])
    assert read_section(Outer, {"name": "a", "inner": Inner(7)}) == Outer("a", Inner(7))
    assert read_section(Inner, {"share": 0.1}, "inner", width=9) == Inner(9, 0.1)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"name": "a", "fats": True}, r"Unknown key outer\.fats\. Did you mean 'fast'"),
        (
            {"name": "a", "inner": {"width": 1, "shar": 1}},
            r"Unknown key outer\.inner\.shar\. Did you mean 'share'",
        ),
        (
            {"name": "a", "other": {"widht": 1}},
            r"Unknown key outer\.other\.widht\. Did you mean 'width'",
        ),
        ({"fast": True}, r"outer lacks the key 'name'; it has fast"),
        ({"name": "a", "inner": {}}, r"outer\.inner lacks the key 'width'; it has none"),
        ({"name": 3}, r"outer\.name=3 must be a text"),
        ({"name": "a", "fast": 1}, r"outer\.fast=1 must be true or false"),
        ({"name": "a", "limit": True}, r"outer\.limit=True must be a whole number or null"),
        ({"name": "a", "limit": 2.0}, r"outer\.limit=2\.0 must be a whole number or null"),
        ({"name": "a", "inner": {"width": "3"}}, r"outer\.inner\.width='3' must be a whole number"),
        ({"name": "a", "inner": 3}, r"outer\.inner=3 must be a section of keys"),
        ({"name": "a", "other": 3}, r"outer\.other=3 must be a section of keys or null"),
        (
            {"name": "a", "betas": [0.1]},
            r"outer\.betas=\[0\.1\] must be a list of 2 values: a number, a number",
        ),
        ({"name": "a", "betas": "ab"}, r"outer\.betas='ab' must be a list of 2"),
        ({"name": "a", "places": 1}, r"outer\.places=1 must be a list, each a whole number"),
        ({"name": "a", "places": [1, "x"]}, r"outer\.places\[1\]='x' must be a whole number"),
        ({"name": "a", "port": 10}, r"outer\.port=10 must be a whole number from 0 to 9 or null"),
        ({"name": "a", "seconds": 0}, r"outer\.seconds=0 must be a number above 0"),
        ({"name": "a", "seconds": float("nan")}, r"outer\.seconds=nan must be a number above 0"),
        ({"name": "a", "kind": "simpel"}, r"outer\.kind='simpel'\. Did you mean 'simple'"),
        ({"name": "a", "kind": 3}, r"outer\.kind=3 must be simple or grounded or null"),
        ([1], r"outer must be a section of keys, got \[1\]"),
    ],
)
def test_a_mistake_names_key_value_and_expectation(given: Any, message: str) -> None:
    with pytest.raises(UserError, match=message):
        read_section(Outer, given, "outer")


def test_a_folder_may_be_called_by_a_number() -> None:
    assert read_section(Outer, {"name": "a", "output": 7}).output == "7"
    with pytest.raises(UserError, match="output=True must be a text that is not empty or null"):
        read_section(Outer, {"name": "a", "output": True})


def test_half_a_surrogate_pair_is_refused() -> None:
    with pytest.raises(UserError, match="outer holds a text that is not Unicode"):
        read_section(Outer, {"name": "\ud800"}, "outer")


def test_a_secret_is_not_reported() -> None:
    with pytest.raises(UserError, match="must be a text that is not empty or null") as error:
        read_section(Outer, {"name": "a", "secret": [5317]})
    assert "5317" not in str(error.value)


def test_commands_read_their_settings_with_it() -> None:
    with pytest.raises(UserError, match=r"train\.keep\.last='two' must be a whole number"):
        TrainSettings.from_dict({"steps": 1, "batch_size": 1, "lr": 1, "keep": {"last": "two"}})
    with pytest.raises(UserError, match=r"Unknown key train\.kepe\. Did you mean 'keep'"):
        TrainSettings.from_dict({"steps": 1, "batch_size": 1, "lr": 1, "kepe": {}})
    for wrong, message in (
        ({"render": "no"}, "render='no' must be true or false"),
        ({"workers": 0}, "workers=0"),
        ({"max_steps": 1.5}, "max_steps=1.5"),
        ({"split": "tset"}, "tset"),
        ({"env": "robome"}, "Unknown environment 'robome'"),
        ({"video": "some"}, "video='some'"),
        ({"timeout_s": 0}, "timeout_s=0"),
        ({"draw": "need"}, "'needed'"),
    ):
        with pytest.raises(UserError, match=message):
            RolloutSettings.from_config({"model": "x", **wrong})
    with pytest.raises(UserError, match="MME_VLA_API_KEY"):
        ServeSettings.from_dict({"host": "0.0.0.0", "require_key": True, "api_key": ""})
    with pytest.raises(UserError, match=r"Unknown key limits\.frame\. Did you mean 'frames'"):
        ServeSettings.from_dict({"limits": {"frame": 3}})
