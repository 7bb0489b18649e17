"""Scenes of the tests of tasks: physics alone, each built once a module."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

Build = Callable[..., Any]


@pytest.fixture(scope="module")
def build_task() -> Iterator[Build]:
    """Builds a task of a seed and a difficulty, or resets the one that was built before."""
    from helpers.env_tasks import make

    scenes: dict[Any, Any] = {}

    def build(task: Any, seed: int, difficulty: str, **settings: Any) -> Any:
        key = (task, seed, difficulty, *settings.items())
        if key in scenes:
            scenes[key].reset()
        else:
            scenes[key] = make(task, seed, difficulty, **settings)
        return scenes[key]

    yield build
    for scene in scenes.values():
        scene.close()


@pytest.fixture
def env(request: pytest.FixtureRequest, build_task: Build) -> Any:
    """The module's `SCENE`, or that of the test, reset."""
    return build_task(*getattr(request, "param", None) or request.module.SCENE)


@pytest.fixture
def hand(env: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    from helpers.env_tasks import Hand

    return Hand(env, monkeypatch)


@pytest.fixture
def make_unrendered() -> Iterator[Build]:
    """`make_env` without images, by default of one training episode; closed when the test ends."""
    from mme_vla.envs import make_env

    envs = []

    def build(
        task: str = "PickXtimes", split: str = "train", episode: int = 8, *args: Any, **options: Any
    ) -> Any:
        envs.append(make_env(task, split, episode, *args, **{"render": False} | options))
        return envs[-1]

    yield build
    for env in envs:
        env.close()


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two converted episodes with poses and choices, the first with a conditioning video of 8 of
    its 24 frames.
    """
    from helpers.h5_files import write_file
    from mme_vla.data.convert import ConvertOptions, convert
    from mme_vla.data.hdf5 import find_files, list_episodes

    place = tmp_path_factory.mktemp("poses")
    write_file(place / "record_dataset_Alpha.h5", [24, 20], videos=[8, 0], poses=True, choices=True)
    convert(list_episodes(find_files([place])), place / "out", ConvertOptions(images="png"))
    return place / "out"


@pytest.fixture
def tip(env: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    from helpers.env_tasks import Tip

    return Tip(env, monkeypatch)
