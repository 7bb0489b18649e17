"""Films are compressed beside the simulation: the same film, and mistakes that are not lost."""

import threading
from pathlib import Path

import av
import numpy as np
import pytest

from mme_vla.evaluation.rollout.film import BEHIND, EpisodeVideo
from mme_vla.files.media import Film, film_frame

VIEWS = [[np.full((32, 48, 3), shade, np.uint8)] * 2 for shade in range(0, 240, 3)]


def video(folder: Path, kept: str = "all") -> EpisodeVideo:
    return EpisodeVideo(lambda outcome, goal: folder / f"{outcome}.mp4", kept)


def test_the_film_shows_what_was_added_in_its_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compressed, add = [], Film.add

    def seen(film: Film, picture: np.ndarray) -> None:
        compressed.append((threading.current_thread().name, picture))
        add(film, picture)

    monkeypatch.setattr(Film, "add", seen)
    drawn = video(tmp_path)
    for views in VIEWS:
        drawn.add(views, "a caption")
    path = drawn.finish("success", "")
    assert path == tmp_path / "success.mp4"
    assert all(thread.startswith("film") for thread, _ in compressed)
    for (_, picture), views in zip(compressed, VIEWS, strict=True):
        assert np.array_equal(picture, film_frame(views, "a caption"))
    with av.open(str(path)) as film:
        shown = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(shown) == len(VIEWS)
    for picture, (shade, _) in zip(shown, VIEWS, strict=True):  # the encoder's own bytes are not compared: it may round
        assert abs(picture[:32].astype(float) - shade[0, 0]).mean() < 3


def test_a_slow_film_is_waited_for_only_when_it_falls_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, add = threading.Event(), Film.add

    def slow(film: Film, picture: np.ndarray) -> None:
        assert gate.wait(10)
        add(film, picture)

    monkeypatch.setattr(Film, "add", slow)
    drawn = video(tmp_path)
    for _ in range(BEHIND):
        drawn.add(VIEWS[0])  # none is compressed yet
    gate.set()
    assert drawn.finish("fail", "") is not None


def test_what_goes_wrong_beside_the_simulation_is_raised(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(film: Film, picture: np.ndarray) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(Film, "add", full)
    drawn = video(tmp_path)
    drawn.add(VIEWS[0])
    with pytest.raises(OSError, match="no space"):
        drawn.finish("success", "")


def test_a_film_that_is_not_kept_leaves_nothing(tmp_path: Path) -> None:
    drawn = video(tmp_path, "failure")
    for views in VIEWS:
        drawn.add(views)
    assert drawn.finish("success", "") is None
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("film")]
