"""The demonstration in examples/: with a memory a policy learns what only the video showed, without
one it cannot.
"""

from functools import partial
from pathlib import Path

import pytest

from helpers import REPOSITORY
from mme_vla.testing.small import BEYOND

GUESSING = 0.75
# no square in the first frame and the last
LEARNING = [model for model in BEYOND if not model.startswith("anchors")]
TOWER = {"depth": 1, "image_size": 16, "patch_size": 4, "width": 16, "mlp_dim": 16, "num_heads": 1}


@pytest.fixture
def learn(monkeypatch):
    monkeypatch.syspath_prepend(REPOSITORY / "examples")
    import memory_matters

    monkeypatch.setitem(
        memory_matters.OF_KIND, "learned_topk", {"pool": memory_matters.LENGTH, "hidden": 32}
    )
    short = {"episodes": 32, "lr": 3e-3, "every": 25, "enough": 0.4 * GUESSING}
    return partial(memory_matters.learn, steps=300, backbone={"depth": 1, "vision": TOWER}, **short)


def test_a_memory_learns_what_only_the_video_showed(learn):
    assert learn("framesamp_expert")["error"] < 0.5 * GUESSING


@pytest.mark.nightly
@pytest.mark.parametrize("model", [*LEARNING, "actions_context", "spacetime_modul"])
def test_so_does_each_memory_beyond_the_paper(learn, model):
    assert learn(model)["error"] < 0.5 * GUESSING


def test_without_memory_it_stays_a_guess(learn):
    assert learn("pi05", steps=100)["error"] > 0.9 * GUESSING


def test_the_picture_has_whole_intervals_and_their_number_of_episodes(learn, monkeypatch, tmp_path):
    import memory_matters

    drawn = []
    monkeypatch.setattr(memory_matters, "svg", lambda canvas: drawn.append(canvas) or "<svg/>")
    errors = [0.2, 1.6, 0.3, 1.5]
    results = [
        {"model": model, "error": 0.9, "errors": errors} for model in ("framesamp_modul", "pi05")
    ]
    memory_matters.plot(results, Path(tmp_path) / "picture.svg")
    (axes,) = drawn[0].axes
    assert "95 % over 4 unseen episodes" in axes.get_xlabel()
    assert max(max(line.get_xdata(), default=0) for line in axes.lines) < axes.get_xlim()[1]
