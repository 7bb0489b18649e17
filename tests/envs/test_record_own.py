"""Recording an environment of the user's own: an interrupted command continues, and says when it
cannot.
"""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from helpers import REPOSITORY
from mme_vla.cli.record import record_environment
from mme_vla.config.plugins import import_plugins
from mme_vla.envs.base import environment
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.robomme.recording.own import episode_file, record_own
from mme_vla.errors import UserError
from mme_vla.utils import read_json

pytest.importorskip("lerobot", reason="writes a LeRobot dataset: uv sync --inexact --extra data")


@pytest.fixture
def demonstrated(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of each demonstration of examples/blink; the third one is interrupted."""
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "blink")
    import_plugins(["blink"])
    numbers: list[int] = []
    kind = type(environment("blink"))
    demonstrate = kind.demonstrate

    def interrupted(self: Any, env: Any) -> Iterator[np.ndarray]:
        numbers.append(len(numbers))
        if len(numbers) == 3:
            raise KeyboardInterrupt
        yield from demonstrate(self, env)

    monkeypatch.setattr(kind, "demonstrate", interrupted)
    return numbers


def test_an_interrupted_recording_continues_with_the_missing_episodes(
    demonstrated: list[int], tmp_path: Path
) -> None:
    words = {
        "env": "blink",
        "tasks": "all",
        "task": None,
        "split": "train",
        "output": str(tmp_path / "data"),
        "fps": 20,
    }
    config = OmegaConf.create({**words, "episodes": 4})
    with pytest.raises(KeyboardInterrupt):
        record_environment(config)
    assert not (tmp_path / "data").exists()
    (tmp_path / "data").mkdir()  # an empty folder is as good as none
    with pytest.raises(UserError, match="interrupted recording of other episodes"):
        record_environment(OmegaConf.create({**words, "episodes": 2}))
    record_environment(config)
    assert len(demonstrated) == 5  # three, and the two that were missing
    assert read_json(tmp_path / "data" / "meta" / "info.json", "a dataset")["total_episodes"] == 4
    assert [path.name for path in tmp_path.iterdir()] == ["data"]
    with (tmp_path / "data" / "meta" / "facts.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["episode"] for row in rows] == ["0", "1", "2", "3"]
    assert {(row["fact"], row["from"], row["to"], row["needed"]) for row in rows} == {
        ("light", "0", "3", "4")
    }
    with pytest.raises(UserError, match="exists already"):
        record_environment(config)


def test_a_recording_has_the_robots_names_of_an_action(
    demonstrated: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = type(environment("blink"))
    action = kind.embodiment["action"]
    names = [f"joint {number} of mine" for number in range(action["width"])]
    named = {**kind.embodiment, "action": {**action, "names": names}}
    root = tmp_path / "data"
    monkeypatch.setattr(kind, "embodiment", named)
    words = {"env": "blink", "tasks": "all", "task": None, "split": "train", "fps": 20}
    record_environment(OmegaConf.create({**words, "output": str(root), "episodes": 1}))
    features = read_json(root / "meta" / "info.json", "a dataset")["features"]
    assert features["action"]["names"] == names
    assert features["observation.state"]["names"][0] == "state 0"


def test_an_episode_without_options_does_not_get_those_of_another(tmp_path: Path) -> None:
    option = {"label": "a", "action": "press", "need_parameter": False}
    specs = [EpisodeSpec("Blink", "train", n, n, "easy") for n in range(2)]
    columns = {
        "observation.images.top": np.zeros((3, 16, 16, 3), np.uint8),
        "observation.state": np.zeros((3, 2), np.float32),
        "action": np.zeros((3, 2), np.float32),
        "is_demo": np.zeros((3, 1), bool),
        "task": np.array("press"),
    }
    (tmp_path / "work").mkdir()
    for spec, options in zip(specs, ([], [option]), strict=True):
        path = tmp_path / "work" / episode_file(spec)
        np.savez(path, **columns, options=np.array(json.dumps(options)))
    record_own(environment("mme_vla"), specs, tmp_path / "data", tmp_path / "work")
    records = read_json(tmp_path / "data" / "meta" / "robomme_episodes.json", "records")["episodes"]
    assert [record["options"] for record in records] == [[], [option]]
    assert [record["episode_index"] for record in records] == [0, 1]


def _record_blink(monkeypatch: pytest.MonkeyPatch, output: Path, observe: Any) -> None:
    """Record two episodes of examples/blink whose observations a function changes."""
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "blink")
    import_plugins(["blink"])
    kind = type(environment("blink"))
    make = kind.make

    def changed(self: Any, spec: EpisodeSpec, render: bool = True) -> Any:
        env = make(self, spec, render)
        observed = env.observe
        env.observe = lambda light=False: observe(spec.episode, env.time, observed(light))
        return env

    monkeypatch.setattr(kind, "make", changed)
    words = {"env": "blink", "tasks": "all", "task": None, "split": "train", "fps": 20}
    record_environment(OmegaConf.create({**words, "output": str(output), "episodes": 2}))


def _second_camera(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return frame | {"wrist": frame["top"]} if episode else frame


def _larger_image(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {**frame, "top": np.zeros((64 + episode, 64, 3), np.uint8)}


def _growing_image(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {**frame, "top": np.zeros((64 + (time > 1), 64, 3), np.uint8)}


def _gray_image(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {**frame, "top": frame["top"][..., 0]}


def _float_image(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {**frame, "top": frame["top"] / 255}


def _channels_first(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {**frame, "top": frame["top"].transpose(2, 0, 1)}


def _other_camera(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {"side": frame["top"], "state": frame["state"]}


def _wider_state(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {**frame, "state": np.zeros(2, np.float32)}


def _lost_state(episode: int, time: int, frame: dict[str, Any]) -> dict[str, Any]:
    return {**frame, "state": frame["state"] * (np.nan if time == 2 else 1)}


@pytest.mark.parametrize(
    ("observe", "words"),
    [
        (_lost_state, r"episode 0: observation\.state has numbers that are not .* in frame 6\."),
        (_second_camera, r"Blink, episode 1: a frame has .*images\.wrist.* as in the episodes bef"),
        (_larger_image, r"Blink, episode 1: a frame has .*images\.top \[65, 64, 3\]"),
        (_growing_image, r"top is uint8 \[64, 64, 3\] and uint8 \[65, 64, 3\]; expected"),
        (_gray_image, r"images\.top is uint8 \[64, 64\]; expected an image as uint8 \[H, "),
        (_float_image, r"images\.top is float64 \[64, 64, 3\]; expected an image as uint8 \[H, "),
        (_channels_first, r"Blink, episode 0: .*top is uint8 \[3, 64, 64\]; expected an im"),
        (_other_camera, r"images\.side .* embodiment names the cameras top, 1 numbers of state"),
        (_wider_state, r"state \[2\], and embodiment names the cameras top, 1 numbers of state"),
    ],
)
def test_a_recording_refuses_frames_of_another_form_and_can_be_resumed(
    observe: Any, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with monkeypatch.context() as changes, pytest.raises(UserError, match=words):
        _record_blink(changes, tmp_path / "data", observe)
    _record_blink(monkeypatch, tmp_path / "data", lambda episode, time, frame: frame)
    assert read_json(tmp_path / "data" / "meta" / "info.json", "a dataset")["total_episodes"] == 2
