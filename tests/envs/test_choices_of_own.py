"""An environment of the user's own whose robot acts by choices: played, recorded and read again."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest
from omegaconf import OmegaConf

from mme_vla.cli.record import record_environment
from mme_vla.data.episodes import EpisodeSource
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import benchmark_action, choice_action
from mme_vla.envs.base import CHOICES, OPTIONS, Actions, Environment
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.errors import UserError
from mme_vla.registry import ENVS

LETTERS = ["a", "b", "c"]


class Rail(gymnasium.Env[Any, Any]):
    """A cart on a rail, which slips: an action moves it by less than it says. The side that it has
    to reach is shown first.
    """

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        self.place = 0.0
        self.side = 1.0 if seed and seed % 2 else -1.0
        return self._observe(self.side), {"goal": "Go to the side.", "frozen": 2}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.place += 0.8 * float(action[0])
        reached = abs(self.place - self.side) < 0.05
        return self._observe(0.0), 0.0, False, False, {"success": reached}

    def oracle(self) -> Mapping[str, Any]:
        return {"choice": "b" if self.side > 0 else "a"}

    def _observe(self, shown: float) -> dict[str, Any]:
        image = np.full((8, 8, 3), int(100 + 50 * shown), np.uint8)
        return {"front": image, "state": np.array([self.place], np.float32)}


def drive(env: Rail, goal: float) -> Iterator[np.ndarray]:
    """Go to a place by what is left, until it is reached."""
    while abs(env.place - goal) >= 0.05:
        yield np.array([np.clip(goal - env.place, -0.5, 0.5)])


class Rails(Environment):
    tasks: ClassVar = ("Go",)
    success: ClassVar = "once"
    cue: ClassVar = "video"
    embodiment: ClassVar = {
        "name": "rails",
        "cameras": {"front": {"augment": "none"}},
        "memory_camera": "front",
        "state": {"width": 1},
        "action": {
            "space": CHOICES,
            "width": len(LETTERS),
            "names": LETTERS,
            "choice": [0, 1, 2],
            "options_length": 16,
            "horizon": 1,
            "frames": None,
        },
        "fps": 10,
        "conditioning_video": True,
    }

    def make(self, spec: EpisodeSpec, render: bool = True) -> Rail:
        return Rail()

    def hold(self, env: Rail) -> np.ndarray:
        return np.zeros(1)

    def choices(self, env: Rail) -> Mapping[str, Actions]:
        return {"go left": drive(env, -1.0), "go right": drive(env, 1.0), "wait": [np.zeros(1)] * 2}


@pytest.fixture
def rails(monkeypatch: pytest.MonkeyPatch) -> Environment:
    monkeypatch.setitem(ENVS._entries, "rails", Rails)
    return Rails()


def test_actions_of_a_generator_follow_from_what_the_one_before_has_changed(
    rails: Environment,
) -> None:
    env = rails.open("Go", "train", 1, action_space=CHOICES)
    frames, report = env.reset()
    assert len(frames["state_list"]) == 3, "two frames of the cue, and the current one"
    assert [option["action"] for option in report[OPTIONS]] == ["go left", "go right", "wait"]
    frames, *_, report = env.step({"choice": "C"})
    assert frames["state_list"] == [0, 0] and report["status"] == "ongoing"
    frames, *_, report = env.step({"choice": "B"})
    np.testing.assert_allclose(np.ravel(frames["state_list"]), [0.4, 0.8, 0.96], atol=1e-6)
    assert report["status"] == "success"


@pytest.mark.parametrize(
    ("choices", "words"),
    [
        ({}, "offers no choices"),
        ({"rest": []}, "no actions for 'rest'"),
        ({f"go {number}": [0] for number in range(27)}, "27 entries, and there are 26 letters"),
    ],
)
def test_choices_that_cannot_be_offered_are_refused(
    rails: Environment, choices: Mapping[str, Actions], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Rails, "choices", lambda self, env: choices)
    with pytest.raises(UserError, match=words):
        rails.open("Go", "train", 0, action_space=CHOICES).reset()


def test_a_choice_that_is_carried_out_already_takes_a_step(
    rails: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Rails, "choices", lambda self, env: {"stay": drive(env, 0.0)})
    env = rails.open("Go", "train", 0, action_space=CHOICES)
    env.reset()
    frames, *_, report = env.step({"choice": "a"})
    assert frames["state_list"] == [0] and report["status"] == "ongoing"
    monkeypatch.delattr(Rails, "hold")
    with pytest.raises(UserError, match=r"Rails cannot pause, as .* a choice without actions"):
        env.step({"choice": "a"})


def test_the_oracles_choices_are_recorded_and_read_as_decisions(
    rails: Environment, tmp_path: Path
) -> None:
    pytest.importorskip("lerobot", reason="writes a LeRobot dataset: uv sync --extra data")
    words = {"env": "rails", "tasks": "all", "task": None, "split": "train", "episodes": 2}
    record_environment(OmegaConf.create({**words, "fps": None, "output": str(tmp_path / "data")}))
    robot = Embodiment.from_dict(rails.embodiment)
    source = EpisodeSource(tmp_path / "data", robot=robot)
    assert source.exec_starts.tolist() == [2, 2]
    for episode, letter in enumerate("ab"):
        assert source.task(episode) == "Go"
        assert [option.action for option in source.options(episode)] == [
            "go left", "go right", "wait",
        ]  # fmt: skip
        assert list(source.decisions(episode)) == [2]
        chunk, known = source.action_chunk(episode, 2, 1)
        np.testing.assert_array_equal(chunk[0], choice_action(robot.action, {"choice": letter}))
        assert known.all()


def test_a_choice_as_an_action_and_back(rails: Environment) -> None:
    space = Embodiment.from_dict(rails.embodiment).action
    action = choice_action(space, {"choice": "C", "point": None})
    assert action.tolist() == [0, 0, 1]
    assert benchmark_action(space, action) == {"choice": "C", "point": []}


def test_a_recording_of_choices_needs_every_camera_of_the_robot(
    rails: Environment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("lerobot", reason="writes a LeRobot dataset: uv sync --extra data")
    cameras = {"front": {"augment": "none"}, "wrist": {"augment": "none"}}
    monkeypatch.setattr(Rails, "embodiment", {**Rails.embodiment, "cameras": cameras})
    words = {"env": "rails", "tasks": "all", "task": None, "split": "train", "episodes": 1}
    with pytest.raises(UserError, match=r"images\.front .* names the cameras front, wrist, 1 num"):
        record_environment(
            OmegaConf.create({**words, "fps": None, "output": str(tmp_path / "data")})
        )
