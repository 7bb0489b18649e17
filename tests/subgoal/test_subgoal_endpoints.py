"""`subgoal=openai` and `subgoal=notebook` as an evaluation builds them: retries, cost, and a replay without a key."""

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from helpers.chat_server import Reply, chat_server, failure, says
from helpers.rollout_fakes import quick_policy
from mme_vla.cli.evaluate import choose_subgoals, report_usage
from mme_vla.config.composition import compose
from mme_vla.policy.mme import MMEPolicy
from mme_vla.subgoal.notebook import MONITOR

pytest.importorskip("openai", reason="needs the extra openai")
SECRET = "sk-not-a-real-key"
PLAN = {"description": "x", "subgoal": "press the button", "notes": [{"kind": "count", "name": "pressed", "value": 0}]}


def answering(request: dict[str, Any]) -> Reply:
    """A plan, or what the notebook's monitor asks."""
    asks_whether = request["messages"][0]["content"] == MONITOR
    return says(json.dumps({"why": "", "done": False} if asks_whether else PLAN))


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return quick_policy("simplesg")


def heard(policy: MMEPolicy, name: str, *words: str) -> tuple[list[str | None], Any]:
    """Two subgoals of an episode, and the predictor, of `mme-vla evaluate subgoal=<name> <words>`."""
    prices, quick = ("input_price=2", "output_price=10"), ("backoff=0", "interval=16", "requests_per_minute=null")
    config = compose("evaluate", [f"subgoal={name}", *(f"subgoal.{word}" for word in (*prices, *quick)), *words])
    section = OmegaConf.to_container(config.subgoal, resolve=True)
    assert isinstance(section, dict)
    predictor = choose_subgoals(policy, {str(key): value for key, value in section.items()})
    assert predictor is not None
    episode, subgoals = predictor.start_episode("press it", None, "StopCube"), []
    for step in range(2):
        # The first question of a late task is asked again after its step alone; the notebook's monitor at every one.
        episode.observe(np.full((1 if step == 0 else 100, 32, 32, 3), step, np.uint8))
        subgoals.append(predictor.predict([episode])[0].text)
    return subgoals, predictor


@pytest.mark.parametrize("name", ["openai", "notebook"])
def test_an_endpoint_is_tried_again_its_cost_is_reported_and_its_replies_are_replayed(
    name: str, policy: MMEPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", SECRET)
    cache, failures = f"subgoal.cache={tmp_path}", [failure(503, f"busy, key={SECRET}"), failure(429, "slowly")]
    with chat_server() as server, caplog.at_level(logging.INFO):
        server.respond = lambda request: failures.pop() if failures else answering(request)
        subgoals, predictor = heard(policy, name, f"subgoal.base_url={server.url}", cache)
        assert subgoals == ["press the button"] * 2
        assert set(server.keys) == {f"Bearer {SECRET}"}
        report_usage(predictor.usage)
    # 300 tokens read and 100 written an answer: 300·2 + 100·10 = 1,600 millionths each.
    assert caplog.messages[-1] == "subgoals: 2 calls, 2 retries, 600 tokens read, 200 tokens written, $0.0032"
    assert SECRET not in caplog.text

    monkeypatch.delenv("OPENAI_API_KEY")  # and the server is gone
    again, replayed = heard(policy, name, cache)
    assert again == subgoals
    assert (replayed.usage.calls, replayed.usage.cached, replayed.usage.cost) == (0, 2, 0)
    with caplog.at_level(logging.INFO):
        report_usage(replayed.usage)
    assert caplog.messages[-1] == "subgoals: 2 answers from the cache"
