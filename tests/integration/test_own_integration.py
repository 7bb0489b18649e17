"""The worked example of docs/extend/add-an-integration.md: an integration of one's own is checked,
learns and acts.
"""

import numpy as np
import pytest
import torch

from helpers import REPOSITORY
from mme_vla import MMEPolicy, build_policy
from mme_vla.testing import check_integration
from mme_vla.testing.small import open_gates, random_batch, unit_stats

EXAMPLE = REPOSITORY / "examples" / "gist"


@pytest.fixture
def policy(monkeypatch: pytest.MonkeyPatch) -> MMEPolicy:
    monkeypatch.syspath_prepend(EXAMPLE)
    policy = build_policy(
        "pi05", config_dir=EXAMPLE / "configs", memory="framesamp", integration="gist"
    )
    policy.require_processor().stats = unit_stats()
    open_gates(policy)
    return policy


def test_the_page_shows_the_files_that_are_tested() -> None:
    page = (REPOSITORY / "docs" / "extend" / "add-an-integration.md").read_text()
    for file in ("gist.py", "configs/integration/gist.yaml"):
        assert (EXAMPLE / file).read_text().strip() in page, file


def test_it_keeps_an_integrations_contract(policy: MMEPolicy) -> None:
    check_integration("gist")
    check_integration("gist", memory="ttt")


def test_it_learns_and_acts(policy: MMEPolicy) -> None:
    assert policy.config["name"] == "pi05"  # the model file that the parts were put into
    batch = random_batch(policy, valid=32)
    policy(batch)[0].backward()
    assert policy.integration.get_parameter("to_condition.weight").grad.abs().sum() > 0  # type: ignore[union-attr]
    episode = policy.start_episode("press the button")
    frames = np.random.default_rng(0).integers(0, 256, (5, 64, 64, 3), dtype=np.uint8)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((5, 8), np.float32))
    chunk = policy.act(episode)
    assert chunk.shape == (20, 8)
    assert torch.isfinite(torch.from_numpy(chunk)).all()
