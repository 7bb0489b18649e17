"""A policy plays the tasks as choices, loaded here or behind a real socket, as it is evaluated."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.play_fakes import OPTIONS, BlocksEnv
from helpers.rollout_fakes import quick_policy, use_inline_envs
from helpers.serving_fakes import Served
from mme_vla.config.composition import compose
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions, facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import read_records
from mme_vla.extras.play import cli
from mme_vla.extras.play.game import ChoiceSession
from mme_vla.extras.play.players import Player
from mme_vla.policy.mme import MMEPolicy

pytestmark = pytest.mark.usefixtures("blocks")
OPEN: list[BlocksEnv] = []
"""Environments that were made, in order."""


class EndlessBlocks(BlocksEnv):
    """Any block may be pressed at any time, and the picture tells how many were."""

    def step(self, action: dict[str, Any]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, *_ = super().step(action)
        for frame in observation["front_rgb_list"]:
            frame[: 9 * len(self.pressed)] = 255
        return observation, 0.0, False, False, self._info("ongoing")

    def _info(self, status: str) -> dict[str, Any]:
        return {**super()._info(status), "available_multi_choices": OPTIONS[:2]}


def open_blocks(**_: Any) -> BlocksEnv:
    OPEN.append(EndlessBlocks())
    return OPEN[-1]


@pytest.fixture
def blocks(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Episodes are those of the blocks, without the simulator."""

    def make(
        which: Any, limit_of: Callable[[str], int], max_choices: int, images: bool, **_: Any
    ) -> ChoiceSession:
        limit = limit_of(which.task)
        return ChoiceSession(open_blocks(), which, max_choices, images, max_steps=limit)

    monkeypatch.setattr(cli, "make_session", make)
    monkeypatch.setattr(cli, "render_backend", lambda: None)
    monkeypatch.setattr("mme_vla.envs.make.require_simulator", lambda: None)
    use_inline_envs(monkeypatch)
    OPEN.clear()
    yield
    OPEN.clear()


def chooser(**others: Any) -> MMEPolicy:
    memory = {"budget": 64, "grid": 1}
    embodiment = "robomme_choice_front"
    return quick_policy("framesamp_modul", 8, embodiment=embodiment, memory=memory, **others).eval()


def play(folder: Path, *words: str, most: int | None = 6) -> list[EpisodeRecord]:
    """Records of the play command on two episodes. most: choices; None: the command's own limit."""
    common = ["task=VideoUnmask", "episodes=2", f"output={folder}"]
    if most is not None:
        common.append(f"max_choices={most}")
    cli.main(compose("play", [*common, *words]))
    return read_records(folder / "episodes.jsonl")


def taken() -> list[list[tuple[str, tuple[float, ...]]]]:
    """Letters and points that each environment got, if any, in no order; they are forgotten."""
    rows = []
    for env in OPEN:
        steps = []
        for action in env.received_actions:
            point = np.minimum(action["point"], 255).tolist() if action["choice"] == "a" else []
            steps.append((action["choice"], tuple(point)))
        if steps:  # an episode may begin once more to render its video
            rows.append(steps)
    OPEN.clear()
    return sorted(rows)


def test_a_served_policy_plays_what_it_chooses_when_it_is_evaluated(tmp_path: Path) -> None:
    policy = chooser()
    with Served(policy, max_batch=1, flow_steps=policy.info.sample_steps) as served:
        records = play(
            tmp_path / "played", f"server=ws://127.0.0.1:{served.server.port}", "protocol=mme_vla"
        )
    played = taken()
    settings = RolloutSettings(max_steps=1300, max_actions=6, workers=1, max_batch=1)
    facts = facts_of(policy, "test", None, settings, None)
    options = RunOptions(base=open_blocks, show_progress=False)
    jobs = [Job("VideoUnmask", "test", episode) for episode in range(2)]
    EvaluationRun(policy, jobs, tmp_path / "evaluated", facts, settings, options).run()
    assert played == taken()
    assert [len(row) for row in played] == [6, 6]
    assert len({point for row in played for _, point in row}) > 2, "it looks at what it is shown"
    evaluated = read_records(tmp_path / "evaluated" / "episodes.jsonl")
    steps = {record.episode: record.steps for record in evaluated}
    assert {record.episode: record.steps for record in records} == steps
    assert {record.action_space for record in records} == {"multi_choice"}
    assert {record.run for record in records} == {record.run for record in evaluated}, (
        "`results` has one row for both"
    )
    assert [len(record.extra["decisions"]) for record in records] == [6, 6]
    assert [record.outcome for record in records] == ["timeout", "timeout"]


def test_a_checkpoint_plays_as_its_server_does(tmp_path: Path) -> None:
    checkpoint = tmp_path / "step_000003"
    chooser().save_pretrained(checkpoint)
    play(tmp_path / "here", f"checkpoint={checkpoint}")
    here = taken()
    policy = MMEPolicy.from_pretrained(checkpoint)
    with Served(
        policy, str(checkpoint), max_batch=1, flow_steps=policy.info.sample_steps
    ) as served:
        records = play(tmp_path / "there", f"server=ws://127.0.0.1:{served.server.port}")
    assert here == taken()
    assert {record.checkpoint for record in records} == {3}


def test_a_policy_plays_for_as_many_steps_as_its_evaluation(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Player, "max_choices", 2)  # of the other players
    checkpoint = tmp_path / "step_000003"
    chooser().save_pretrained(checkpoint)
    played = play(tmp_path / "played", f"checkpoint={checkpoint}", "max_steps=20", most=None)
    settings = RolloutSettings(max_steps=20, workers=1, max_batch=1)
    policy = MMEPolicy.from_pretrained(checkpoint).eval()
    facts = facts_of(policy, None, str(checkpoint), settings, None)
    options = RunOptions(base=open_blocks, show_progress=False)
    jobs = [Job("VideoUnmask", "test", episode) for episode in range(2)]
    EvaluationRun(policy, jobs, tmp_path / "evaluated", facts, settings, options).run()
    evaluated = read_records(tmp_path / "evaluated" / "episodes.jsonl")
    assert [record.chunks for record in evaluated] == [
        len(record.extra["decisions"]) for record in played
    ]
    assert all(len(record.extra["decisions"]) > 2 for record in played)
    for record, other in zip(played, evaluated, strict=True):
        assert (record.run, record.outcome, record.steps) == (other.run, "timeout", other.steps)


def test_a_policy_of_motions_is_referred_to_the_evaluation(tmp_path: Path) -> None:
    with (
        Served(quick_policy("pi05")) as served,
        pytest.raises(UserError, match=r"acts by joint_angle, and play offers choices .* evaluate"),
    ):
        play(tmp_path / "run", f"server=ws://127.0.0.1:{served.server.port}")
    assert not (tmp_path / "run").exists()


def test_a_policy_and_a_player_are_one_too_many(tmp_path: Path) -> None:
    words = ["server=ws://127.0.0.1:1", "player=random"]
    with pytest.raises(UserError, match=r"server=.* and player=random are two players"):
        play(tmp_path / "run", *words)
    with pytest.raises(UserError, match="are two policies: leave out one"):
        play(tmp_path / "run", words[0], "checkpoint=nano")


def test_a_server_that_refuses_a_request_ends_its_episodes_with_the_reason(tmp_path: Path) -> None:
    with Served(chooser()) as served:
        url = f"ws://127.0.0.1:{served.server.port}"

        def refuse(*_: Any, **__: Any) -> Any:
            raise UserError("no more")

        served.server.engine.run = refuse  # type: ignore[method-assign, assignment]
        records = play(tmp_path / "run", f"server={url}")
    assert [record.outcome for record in records] == ["error", "error"]
    assert all("no more" in str(record.error) for record in records)
