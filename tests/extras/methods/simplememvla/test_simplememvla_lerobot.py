"""SimpleMemVLA through the LeRobot plugin."""

from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="needs LeRobot: uv sync --inexact --extra lerobot")
pytest.importorskip("transformers", reason="needs the extra `vlm`: uv sync --inexact --extra vlm")

from helpers.plugins import plugin
from mme_vla import build_policy
from mme_vla.testing.small import unit_stats

SIDE = 64


def test_it_acts_in_lerobots_loop_as_by_itself(tmp_path: Path) -> None:
    policy = build_policy("simplememvla", processor={"max_words": 4, "seconds": 2})
    policy.require_processor().stats = unit_stats(policy.embodiment)
    policy.save_pretrained(tmp_path / "ours")
    rng, states = np.random.default_rng(0), np.full((1, 8), 0.1, np.float32)
    frames = [
        {name: rng.integers(0, 255, (1, SIDE, SIDE, 3), np.uint8) for name in ("front", "wrist")}
        for _ in range(3)
    ]
    episode = policy.start_episode("touch it", seed=42)
    for views in frames:
        episode.observe(views, states)
        expected = policy.act(episode)
    with plugin("lerobot_policy_mme_vla", "lerobot_policy_mme_vla", keep=True) as package:
        import lerobot_policy_mme_vla.convert  # noqa: F401
        from lerobot_policy_mme_vla.modeling_mme_vla import MMEVLAPolicy

        package.convert.main([str(tmp_path / "ours"), str(tmp_path / "theirs")])
        loaded = MMEVLAPolicy.from_pretrained(tmp_path / "theirs")
        loaded.reset()
        assert not loaded.supports_rtc()
        for views in frames:
            images = {
                name: torch.from_numpy(view).movedim(-1, 1).float() / 255
                for name, view in views.items()
            }
            batch = {
                "observation.images.image": images["front"],
                "observation.images.wrist_image": images["wrist"],
            }
            chunk = loaded.predict_action_chunk(
                {**batch, "observation.state": torch.from_numpy(states), "task": ["touch it"]}
            )
    np.testing.assert_allclose(chunk[0].numpy(), expected, atol=1e-5)
