"""An audit names what a served policy reads, from outside, and agrees with the card from inside."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import Tensor

from helpers import REPOSITORY
from helpers.serving_fakes import Served
from helpers.tiers import slow_or_nightly
from mme_vla.cli.record import record_environment
from mme_vla.config import plugins
from mme_vla.config.plugins import import_plugins
from mme_vla.data.sources import open_sources
from mme_vla.embodiment import Embodiment
from mme_vla.envs.base import environment
from mme_vla.evaluation.rollout import evaluation
from mme_vla.evaluation.rollout.evaluation import RunOptions, choose_episodes, facts_of
from mme_vla.evaluation.rollout.local import LocalEnvs
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import find_records, read_records
from mme_vla.extras.audit.audit import Audit, AuditSettings, run_audit, scenes_a_task
from mme_vla.extras.audit.conclusion import VERDICTS, resolution
from mme_vla.extras.probing.card import CONTENT, TIME, Card, measure_card
from mme_vla.extras.probing.recordings import Recording, all_recordings
from mme_vla.extras.probing.run import ProbePlan
from mme_vla.memory.base import stack_history
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.serving.remote.policy import RemotePolicy
from mme_vla.serving.remote.settings import ConnectionSettings, ServerChoice
from mme_vla.testing.small import SMALL_VISION, small_policy

pytest.importorskip("lerobot", reason="records a LeRobot dataset: uv sync --inexact --extra data")

SERVERS = REPOSITORY / "examples" / "servers"
SILENT = RunOptions(show_progress=False)


def settings() -> RolloutSettings:
    return RolloutSettings(env="cues", max_steps=20)


class OneEnv(LocalEnvs):
    """A `VecEnv` of one environment in this process."""

    def __init__(self, jobs: Any, workers: int, make: Any, timeout: Any) -> None:
        super().__init__(make)


@pytest.fixture(scope="module")
def examples() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SERVERS)
        patch.setattr(evaluation, "VecEnv", OneEnv)
        patch.setattr(plugins, "_imported", dict(plugins._imported))
        import_plugins(["cues"])
        yield patch


@pytest.fixture(scope="module")
def robot(examples: pytest.MonkeyPatch) -> Embodiment:
    return Embodiment.from_dict(environment("cues").embodiment)


@pytest.fixture(scope="module")
def recordings(
    robot: Embodiment, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, list[Recording]]:
    """Demonstrations, by task."""
    folder = tmp_path_factory.mktemp("demonstrations") / "data"
    words = {"env": "cues", "tasks": "all", "task": None, "split": "train", "fps": 20}
    record_environment(OmegaConf.create({**words, "output": str(folder), "episodes": 8}))
    by_task: dict[str, list[Recording]] = {}
    for recording in all_recordings(open_sources(str(folder), robot)):
        is_told = recording.goal != "follow the light"
        by_task.setdefault("Told" if is_told else "Cues", []).append(recording)
    return by_task


def audit(
    policy: Policy, task: str, folder: Path, lend: list[Recording], scenes: int = 14, **more: Any
) -> Audit:
    jobs = choose_episodes(task, scenes, "test", "cues")
    facts = facts_of(policy, None, None, settings(), None)
    budget = AuditSettings(**more)
    return run_audit(policy, jobs, folder, facts, settings(), SILENT, budget, lend)


def audit_fake(
    name: str, robot: Embodiment, folder: Path, lend: dict[str, list[Recording]], **more: Any
) -> Audit:
    import fakes
    import stub_servers

    task = "Told" if name == "goal" else "Cues"
    with stub_servers.serving("robomme", stub_servers.Stub(policy=fakes.FAKES[name])) as url:
        connection = ConnectionSettings(timeout_s=10, open_s=5, name=name)
        policy = RemotePolicy(ServerChoice(url, "robomme", connection), robot)
        try:
            return audit(policy, task, folder, lend[task], **more)
        finally:
            policy.close()


@pytest.mark.parametrize(
    ("fake", "verdict", "losses"),
    [
        ("video", "content", {"nothing remembered", "no video", CONTENT, "wrong scene first"}),
        ("clock", "clock", {"nothing remembered", TIME}),
        ("memoryless", "nothing", set()),
        ("own_actions", "own chunks", {"nothing remembered", "own chunks lost"}),
        ("last_frame", "last frames", {"nothing remembered", "last frames pushed out", CONTENT}),
        ("goal", "goal", {"another goal"}),
    ],
)
def test_each_planted_policy_is_named(
    fake: str,
    verdict: str,
    losses: set[str],
    robot: Embodiment,
    recordings: dict[str, list[Recording]],
    tmp_path: Path,
) -> None:
    result = audit_fake(fake, robot, tmp_path, recordings)
    assert result.conclusion.verdict == verdict
    beyond = {label for label, loss in result.card.arms.items() if loss.beyond_noise}
    assert losses <= beyond
    assert beyond <= losses or fake in ("video", "clock")
    page = result.page.read_text()
    assert VERDICTS[verdict] in page.replace("&#x27;", "'") and f"Audit of {fake}" in page
    content = json.loads((tmp_path / "audit.json").read_text())
    assert content["conclusion"]["verdict"] == verdict
    assert content["server"]["protocol"] == "robomme"


class ReadsMemory(MMEPolicy):
    """Goes where the light was in the oldest frame it remembers; or, as a clock, by the newest
    frame's number.
    """

    is_clock = False
    direction: Tensor
    middle: Tensor

    def predict_chunk(
        self, batch: Any, episodes: Any, noise: Any, steps: int | None = None
    ) -> Tensor:
        histories = [episode.gather_selection() for episode in episodes]
        return self.sample_actions(replace(batch, history=stack_history(histories)))

    def sample_actions(
        self, batch: Any, draws: Any = None, steps: Any = None, **others: Any
    ) -> Tensor:
        history = batch.history
        sides = []
        for features, positions, mask in zip(
            history.features.float(), history.positions, history.mask, strict=True
        ):
            frames = positions[:, 0].masked_fill(~mask, torch.inf)
            if not mask.any():
                sides.append(1.0)
            elif self.is_clock:
                newest = float(positions[:, 0].masked_fill(~mask, -torch.inf).max())
                sides.append(-1.0 if newest < 29 else 1.0)
            else:
                oldest = features[frames == frames.min()].flatten()  # its four tokens
                sides.append(float(torch.sign((oldest - self.middle) @ self.direction)))
        width = self.embodiment.action.width
        return torch.tensor(sides)[:, None, None].expand(-1, self.horizon, width)


@pytest.fixture(scope="module")
def remembering(robot: Embodiment) -> ReadsMemory:
    """A policy whose memory is read by rule: the features of both lights are measured, not
    learned.
    """
    import cues

    built = small_policy(
        "framesamp_modul",
        env="cues",
        backbone={"vision": {**SMALL_VISION, "patch_size": 8}},
        memory={"budget": 64, "grid": 2},
    )
    policy = ReadsMemory(
        built.backbone, built.memory, built.integration, built.processor, built.config
    )
    seen = []
    for side in (-1, 1):
        scene = cues.Cues(told=False)
        scene.side, scene.time = side, 0
        episode = policy.start_episode("follow the light")
        image = scene.observe()["top"][None]
        episode.observe({"top": image}, np.zeros((1, 1), np.float32))
        tokens = episode.gather_selection()
        seen.append(tokens.features[tokens.mask].float().flatten())
    policy.direction = seen[1] - seen[0]
    policy.middle = (seen[1] + seen[0]) / 2
    return policy.eval()


@pytest.mark.parametrize("is_clock", slow_or_nightly([False, True], lambda is_clock: not is_clock))
def test_the_cards_from_outside_and_from_inside_agree(
    is_clock: bool,
    remembering: ReadsMemory,
    recordings: dict[str, list[Recording]],
    tmp_path: Path,
) -> None:
    remembering.is_clock = is_clock
    lend = recordings["Cues"]
    jobs = choose_episodes("Cues", 14, "test", "cues")
    facts = facts_of(remembering, None, None, settings(), None)
    plan = ProbePlan(lend=lend, jobs=jobs)
    inside = measure_card(remembering, plan, tmp_path / "inside", facts, settings(), SILENT)
    with Served(remembering) as served:
        connection = ConnectionSettings(timeout_s=60, open_s=5)
        url = f"ws://127.0.0.1:{served.server.port}"
        policy = RemotePolicy(ServerChoice(url, "auto", connection), remembering.embodiment)
        outside = audit(policy, "Cues", tmp_path / "outside", lend)
        policy.close()
    assert outside.conclusion.verdict == ("clock" if is_clock else "content")
    assert inside.matched == outside.card.matched == 1
    inner, outer = inside.memory_or_clock, outside.card.memory_or_clock
    assert inner.score == outer.score == (1.0 if is_clock else 0.0)
    for label in (TIME, CONTENT, "nothing remembered"):
        one, other = inside.arms[label], outside.card.arms[label]
        assert one.low <= other.loss <= one.high and other.low <= one.loss <= other.high, label
        assert one.beyond_noise == other.beyond_noise, label


def test_a_policy_is_audited_alike_here_and_behind_a_server(
    remembering: ReadsMemory, recordings: dict[str, list[Recording]], tmp_path: Path
) -> None:
    remembering.is_clock = False

    def strip(card: Card) -> dict[str, Any]:
        return {label: (loss.success, loss.lost) for label, loss in card.arms.items()}

    here = audit(remembering, "Cues", tmp_path / "here", recordings["Cues"], scenes=6)
    with Served(remembering) as served:
        url = f"ws://127.0.0.1:{served.server.port}"
        connection = ConnectionSettings(timeout_s=60, open_s=5)
        policy = RemotePolicy(ServerChoice(url, "auto", connection), remembering.embodiment)
        there = audit(policy, "Cues", tmp_path / "there", recordings["Cues"], scenes=6)
        policy.close()
    assert strip(here.card) == strip(there.card)


def test_minutes_choose_the_scenes_once_and_say_what_they_cannot_resolve(
    robot: Embodiment, recordings: dict[str, list[Recording]], tmp_path: Path
) -> None:
    result = audit_fake("video", robot, tmp_path, recordings, minutes=1e-4)
    assert result.card.scenes == 3
    assert "resolve=0.3 was not reached with 3 scenes" in " ".join(result.conclusion.sentences)
    records = {path: path.read_bytes() for path in tmp_path.rglob("episodes*.jsonl")}
    assert len(records) == len(result.card.arms) + 2
    again = audit_fake("video", robot, tmp_path, recordings, minutes=100)
    assert again.card.scenes == 3, "the plan is that of the first command"
    assert {path: path.read_bytes() for path in records} == records
    for path in find_records([tmp_path]):
        assert len(read_records(path)) == 3


def test_scenes_are_as_many_as_the_loss_needs() -> None:
    assert [resolution(n) for n in (8, 10, 20)] == [0.5, 0.4, 0.2]
    assert resolution(3) > 1
    assert scenes_a_task(AuditSettings(resolve=0.4), 1) == 10
    assert scenes_a_task(AuditSettings(resolve=0.4), 4) == 3
