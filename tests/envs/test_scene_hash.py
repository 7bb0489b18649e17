"""The digest of a scene: equal for equal values and places, to the last bit, however the scene came
to be.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import numpy as np
import pytest

from mme_vla import UserError
from mme_vla.envs.base import Environment, EpisodeEnv, environment
from mme_vla.envs.metadata import EpisodeSpec, read_row
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT, scene_digest

VALUES: dict[str, Any] = {
    "layout": {"xy": [0.1, -0.25], "yaw": 1.5},
    "objects": {"count": 3, "colours": ["red"]},
}


def test_the_digest_is_this_one_on_every_machine() -> None:
    assert scene_digest(VALUES) == "7346cb5e80baac23"


def test_neither_order_nor_spelling_of_numbers_counts() -> None:
    turned = {"objects": {"colours": ("red",), "count": 3.0}, "layout": {"yaw": np.float32(1.5),
              "xy": np.array([0.1, -0.25])}}  # fmt: skip
    assert scene_digest(turned) == scene_digest(VALUES)


@pytest.mark.parametrize(
    "change",
    [
        {"layout": {"xy": [np.nextafter(0.1, 1), -0.25], "yaw": 1.5}},
        {"layout": {"xy": [-0.25, 0.1], "yaw": 1.5}},
        {"layout": {"xy": [0.1], "yaw": [-0.25, 1.5]}},
        {"objects": {"count": "3", "colours": ["red"]}},
        {"objects": {"count": 3, "colours": ["r", "ed"]}},
        {"objects": {"count": 3, "colours": "red"}},
        {"more": None},
        {"objects": {"count": True, "colours": ["red"]}},
    ],
    ids=str,
)
def test_every_bit_counts(change: dict[str, Any]) -> None:
    assert scene_digest(VALUES | change) != scene_digest(VALUES)


@pytest.mark.parametrize("value", [1 + 2j, {1: 2}, {"a": {0.5}}, b"bytes"], ids=repr)
def test_values_without_one_text_are_refused(value: Any) -> None:
    with pytest.raises(UserError, match="Give plain values in scene_values"):
        scene_digest({"value": value})


# Environments -------------------------------------------------------------------------------------


class Line(gymnasium.Env):
    """A place on a line, which steps move."""

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        self.place = float(seed or 0)
        return self._frame(), {"goal": "move"}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.place += 1
        return self._frame(), 0.0, False, False, {}

    def _frame(self) -> dict[str, Any]:
        return {"state": np.array([self.place], np.float32)}


class Lines(Environment):
    tasks = ("Line",)

    def make(self, spec: EpisodeSpec, render: bool = True) -> Any:
        return Line()


def test_an_environment_that_renders_gives_an_image() -> None:
    with pytest.raises(UserError, match="no image: give one for each camera"):
        Lines().open("Line", "test", 0).reset()


class NamedLines(Lines):
    def scene_values(self, env: Any) -> Mapping[str, Any] | None:
        return {"place": env.place}


def test_an_environment_without_values_says_so() -> None:
    source = Lines()
    env = source.open("Line", "test", 0, render=False)
    assert env.scene_digest == NOT_BUILT
    env.reset()
    assert env.scene_digest == source.scene_digest(source.episode("Line", "test", 0)) == NO_VALUES


def test_an_environment_with_values_is_named_by_those_of_its_reset() -> None:
    source = NamedLines()
    env = source.open("Line", "test", 1, render=False)
    env.reset()
    env.step(None)
    digest = scene_digest({"place": 500_001.0})
    assert env.scene_digest == source.scene_digest(source.episode("Line", "test", 1)) == digest
    assert source.scene_digest(source.episode("Line", "test", 2)) != digest
    assert isinstance(env, EpisodeEnv)


class Flickering(Line):
    """Its frames lack a part at some places."""

    def __init__(self, name: str, lacking: set[float]) -> None:
        self.name = name
        self.lacking = lacking

    def _frame(self) -> dict[str, Any]:
        image = np.zeros((2, 2, 3), np.uint8)
        frame = super()._frame() | {"front": image, "wrist": image}
        if self.place in self.lacking:
            frame.pop(self.name)
        return frame


@pytest.mark.parametrize(
    ("name", "lacking", "message"),
    [
        ("wrist", {2.0}, "frame 2 of .* has front, state, and frame 0 has front, state, wrist"),
        ("state", {2.0}, "frame 2 of .* has front, wrist, and frame 0 has front, state, wrist"),
        ("front", {0.0}, "frame 1 of .* has front, state, wrist, and frame 0 has state, wrist"),
        ("state", {0.0}, "observations have no 'state'"),
    ],
)
def test_frames_of_one_episode_have_the_same_cameras_and_the_state(
    name: str, lacking: set[float], message: str
) -> None:
    env = EpisodeEnv(
        Lines(), Flickering(name, lacking), EpisodeSpec("Line", "test", 0, 0, "easy"), 9
    )
    with pytest.raises(UserError, match=message):
        env.reset()
        env.step(None)
        env.step(None)


# The benchmark ------------------------------------------------------------------------------------


@pytest.fixture
def tasks() -> Iterator[list[Any]]:
    pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")
    made: list[Any] = []
    yield made
    for task in made:
        task.close()


@pytest.mark.parametrize("task", ["VideoRepick", "StopCube"])
def test_a_scene_has_one_digest_however_it_is_built(task: str, tasks: list[Any]) -> None:
    from mme_vla.envs.make import make_env, make_task

    source = environment("mme_vla")
    digest = source.scene_digest(source.episode(task, "test", 0))
    env: Any = make_env(task, "test", 0, render=False)
    tasks.append(env)
    assert env.scene_digest == NOT_BUILT
    for _ in range(2):  # the second reset builds it anew, and the video moves its objects
        env.reset()
        assert env.scene_digest == digest
    built = make_task(task, render=False, **read_row(env.scene_values()).options)
    tasks.append(built)
    built.reset()
    assert scene_digest(built.placed_values()) == digest, "from its values"
    assert source.scene_digest(source.episode(task, "twin", 0)) == digest, (
        "what stays in view is no other scene"
    )
    assert source.scene_digest(source.episode(task, "test", 1)) != digest
