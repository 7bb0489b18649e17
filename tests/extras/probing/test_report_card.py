"""The report card tells a policy that reads time from one that reads content."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.probe_fakes import SIDE, MadeUpSource
from helpers.published import published_folder
from helpers.rollout_fakes import FACTS, InlineEnvs, quick_policy, records, roll, use_inline_envs
from helpers.scripted_env import ScriptedEnv
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.receipts import verify
from mme_vla.evaluation.records import EpisodeKey
from mme_vla.evaluation.rollout.evaluation import RunOptions
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.extras.probing import card as card_module
from mme_vla.extras.probing.arms import read_arm, slug
from mme_vla.extras.probing.card import (
    ARMS,
    CONTENT,
    TIME,
    Recovery,
    card_text,
    clock_scores,
    conclude_card,
    grade,
    outcomes_of,
    recovery,
    run_card,
    write_card,
)
from mme_vla.extras.probing.channels import channel_of
from mme_vla.extras.probing.cli import probe as probe_command
from mme_vla.extras.probing.lines import MomentLine
from mme_vla.extras.probing.probed import DonorEpisodes, ProbedPolicy
from mme_vla.extras.probing.recordings import Recording
from mme_vla.extras.probing.run import ProbePlan
from mme_vla.extras.probing.settings import OfflineSettings
from mme_vla.memory.base import stack_history
from mme_vla.policy.mme import MMEPolicy
from mme_vla.utils import to_json

JOBS = [Job("VideoUnmask", "test", episode) for episode in range(8)]
VIDEO = (5, 21)  # frames of the video of a scene, by its right choice


def image(choice: int) -> np.ndarray:
    """The half of the view that is bright is the right choice."""
    view = np.zeros((SIDE, SIDE, 3), np.uint8)
    view[:, SIDE // 2 * choice :][:, : SIDE // 2] = 255
    return view


class ChoiceEnv(ScriptedEnv):
    """Two choices, the sign of the first joint. Length and image of the video both tell the right
    one.
    """

    def reset(self) -> tuple[dict[str, Any], dict[str, Any]]:
        count = VIDEO[self.episode % 2] + 1
        return self._lists([self._frame() for _ in range(count)]), self._info("ongoing")

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, Any] | None, float, bool, bool, dict[str, Any]]:
        observation, reward, _, late, _ = super().step(action)
        right = len(self.actions) == self.max_steps and (self.joints[0] > 0) == (self.episode % 2)
        status = "success" if right else "timeout" if late else "ongoing"
        return observation, reward, bool(right), late, self._info(status)

    def _frame(self) -> dict[str, Any]:
        return {**super()._frame(), "front_rgb": image(self.episode % 2)}


def make_choice_env(task: str, split: str, episode: int, max_steps: int = 16) -> ScriptedEnv:
    return ChoiceEnv(task, episode, max_steps, 1e9, 0.0, "")


class DonorSource(MadeUpSource):
    """Recorded scenes in which the choice is always 1."""

    def frames(self, episode: int, indices: Any, camera: str | None = None) -> np.ndarray:
        return np.stack([image(1) for _ in indices])


def recordings(count: int = 3) -> list[Recording]:
    source: Any = DonorSource()
    return [Recording(source, episode) for episode in range(count)]


class Reader(MMEPolicy):
    """Chooses by the newest time that it remembers, or by the oldest content."""

    reads: str = TIME
    prototypes: Tensor

    def predict_chunk(self, batch: Any, episodes: Any, draws: Any, steps: Any = None) -> Tensor:
        histories = [episode.required_history() for episode in episodes]
        tokens = [
            self.require_memory().gather_selection(history, len(history) - 1)
            for history in histories
        ]
        return self.sample_actions(
            replace(batch, history=stack_history(tokens, self.device)), draws, steps
        )

    def sample_actions(
        self, batch: Any, draws: Any = None, steps: Any = None, **others: Any
    ) -> Tensor:
        times = batch.history.positions[..., 0]
        if self.reads == TIME:
            choice = (times.amax(1) > sum(VIDEO) / 2).long()
        else:
            oldest = batch.history.features[:, :1].float()
            choice = torch.cdist(oldest, self.prototypes[None].expand(len(oldest), -1, -1))[
                :, 0
            ].argmin(1)
        return 0.01 * draws["noise"] + (choice - 0.5)[:, None, None]


def reader(reads: str) -> Reader:
    base = quick_policy("framesamp_modul", memory={"budget": 4, "grid": 1})
    policy = Reader(
        base.backbone, base.memory, base.integration, base.processor, base.config
    ).eval()
    policy.reads = reads
    contents = []
    for choice in range(2):
        episode = policy.start_episode("")
        views = {camera: image(choice)[None] for camera in policy.embodiment.camera_names}
        episode.observe(views, np.zeros((1, policy.embodiment.state.width), np.float32))
        tokens = policy.require_memory().gather_selection(episode.required_history(), 0)
        contents.append(tokens.features[tokens.mask][0])
    policy.prototypes = torch.stack(contents).float()
    return policy


def outcomes(policy: MMEPolicy, word: str | None, seed: int = 42) -> dict[EpisodeKey, float]:
    donors = recordings()
    if word is not None:
        policy = ProbedPolicy(
            policy, read_arm(word), donors, DonorEpisodes(policy, channel_of(policy), donors)
        ).eval()
    return outcomes_of(
        roll(policy, JOBS, InlineEnvs(base=make_choice_env, max_steps=16), seed=seed)
    )


@pytest.mark.parametrize(("reads", "score"), [(TIME, 1.0), (CONTENT, 0.0)])
def test_a_policy_that_reads_time_scores_one_and_one_that_reads_content_zero(
    reads: str, score: float, tmp_path: Path
) -> None:
    policy = reader(reads)
    arms = {label: outcomes(policy, ARMS[label]) for label in (TIME, CONTENT)}
    card = grade(outcomes(policy, None), arms, outcomes(policy, None, seed=43))
    assert (card.matched, card.noise, card.scenes) == (1.0, 0.0, 8)
    other = CONTENT if reads == TIME else TIME
    assert (
        card.arms[reads].loss == 0.5
        and card.arms[reads].lost == 4
        and card.arms[reads].beyond_noise
    )
    assert card.arms[other].loss == 0 and not card.arms[other].beyond_noise
    clock = card.memory_or_clock
    assert (clock.score, clock.low, clock.high) == (score, score, score)
    write_card(card, tmp_path)
    assert json.loads((tmp_path / "card.json").read_text())["memory_or_clock"]["score"] == score
    assert (
        f"{score:.2f}" in card_text(card)
        and "memory-or-clock" in (tmp_path / "card.html").read_text()
    )


def test_a_card_says_first_what_it_shows_or_that_it_is_too_little(tmp_path: Path) -> None:
    matched = scenes([1] * 12)
    clock = grade(matched, {TIME: scenes([0] * 12), CONTENT: matched}, matched)
    assert conclude_card(clock).startswith(
        "This policy solves 100 % of 12 scenes, time-shifted entries cost 100 points and"
        " content-swapped entries cost 0 points: its memory serves mostly as a clock"
    )
    content = grade(matched, {TIME: matched, CONTENT: scenes([0] * 12)}, matched)
    assert "its memory serves mostly by its content" in conclude_card(content)
    failed = scenes([0] * 3)
    nothing = grade(failed, {TIME: failed, CONTENT: failed}, failed)
    assert "too little to tell whether its memory is a clock" in conclude_card(nothing)
    write_card(replace(nothing, model="other · name", checkpoint="nano"), tmp_path)
    page = (tmp_path / "card.html").read_text()
    assert "<h1>Report card of nano · name</h1>" in page
    assert "every entry seems to be 64 frames later than it was" in page
    assert 'class="note"' not in page, "what was left out is no warning"


def scenes(values: list[int]) -> dict[EpisodeKey, float]:
    return {EpisodeKey("VideoUnmask", number): float(value) for number, value in enumerate(values)}


def test_the_score_is_undefined_where_both_losses_lie_within_noise() -> None:
    matched, again = scenes([1] * 6 + [0] * 6), scenes([1] * 3 + [0] * 6 + [1] * 3)
    card = grade(matched, {TIME: scenes([1] * 2 + [0] * 10), CONTENT: matched}, again)
    assert card.noise == 0.5 and not card.arms[TIME].beyond_noise
    assert (
        card.memory_or_clock.score is None
        and card.memory_or_clock.undefined == "neither loss is beyond noise"
    )
    quiet = grade(
        matched, {TIME: scenes([1] * 2 + [0] * 10), CONTENT: scenes([1] * 4 + [0] * 8)}, matched
    )
    score = quiet.memory_or_clock
    assert score.score == pytest.approx(4 / 6) and score.low is not None and score.high is not None
    assert score.low < 4 / 6 < score.high <= 1
    assert grade(matched, {TIME: scenes([0] * 12)}, matched).memory_or_clock.undefined is not None


def test_each_suite_has_a_score_of_its_own() -> None:
    def outcomes(counting: int, permanence: int) -> dict[EpisodeKey, float]:
        solved = {"PickXtimes": counting, "VideoUnmask": permanence}
        return {EpisodeKey(task, i): float(i < n) for task, n in solved.items() for i in range(8)}

    matched = outcomes(8, 8)
    arms = {TIME: outcomes(0, 8), CONTENT: outcomes(8, 0)}
    scores = clock_scores(matched, arms, matched, {})
    assert {suite: score.score for suite, score in scores.items()} == {
        "Counting": 1.0,
        "Permanence": 0.0,
    }
    card = replace(grade(matched, arms, matched), suites=scores)
    assert (
        card.memory_or_clock.score == 0.5
        and "memory-or-clock score, Counting | 1.00" in card_text(card)
    )
    counting = {key: value for key, value in matched.items() if key.task == "PickXtimes"}
    assert clock_scores(counting, {TIME: counting}, counting, {}) == {}, "all are of one"
    user = {EpisodeKey(task, i): 1.0 for task in ("mine", "yours") for i in range(8)}
    lost = {key: float(key.task == "yours") for key in user}
    scores = clock_scores(user, {TIME: lost, CONTENT: user}, user, {"mine": "A", "yours": "B"})
    assert scores["A"].score == 1.0 and scores["B"].undefined == "neither loss is beyond noise"


def test_committed_cards_follow_from_their_records() -> None:
    folders = sorted((published_folder("clock") / "nano16" / "cards").iterdir())
    assert folders
    for folder in folders:
        assert_card_follows_from_its_records(folder)


def assert_card_follows_from_its_records(folder: Path) -> None:
    figures = json.loads((folder / "card.json").read_text())

    def outcomes(part: str) -> dict[EpisodeKey, float]:
        return outcomes_of(read_folders(find_records([folder / part])))

    matched, again = outcomes("online/unprobed"), outcomes("again")
    arms = {
        label: outcomes(f"online/{slug(read_arm(ARMS[label]).name)}") for label in figures["arms"]
    }
    card = grade(matched, arms, again)
    assert card.scenes == figures["scenes"], folder.name
    for label, loss in card.arms.items():
        published = figures["arms"][label]
        assert to_json(asdict(loss)) == pytest.approx(published), (folder.name, label)
    score = to_json(asdict(card.memory_or_clock))
    assert score == pytest.approx(figures["memory_or_clock"]), folder.name
    scores = clock_scores(matched, arms, again, {})
    assert scores.keys() == figures["suites"].keys(), folder.name
    for suite, of_suite in scores.items():
        assert to_json(asdict(of_suite)) == pytest.approx(figures["suites"][suite]), (
            folder.name,
            suite,
        )


def test_recovery_counts_decisions_until_nothing_changes_any_more() -> None:
    def moments(name: str, changes: list[float], spread: float = 0.1) -> list[MomentLine]:
        return [
            MomentLine(
                name, "VideoUnmask", 16 * i, 0, "", "distract:1", 1.0, 4, [], change, spread, 0.0
            )
            for i, change in enumerate(changes)
        ]

    lines = (
        moments("a", [0.0, 0.5, 0.1, 0.0])
        + moments("b", [0.1, 0.0, 0.0, 0.0])
        + moments("c", [0.5, 0, 0, 0.5])
    )
    assert recovery(lines) == Recovery(2.0, 2, 3, 4.0)
    assert recovery(moments("c", [0.0, 0.5])) == Recovery(None, 0, 1, 2.0)
    assert recovery(moments("d", [0.5, 1e-4, 0.0], spread=0.0)) == Recovery(1.0, 1, 1, 3.0), (
        "a policy without noise"
    )
    assert recovery([]) is None


def test_a_card_says_how_many_decisions_a_recording_has_on_average() -> None:
    card = grade(scenes([1, 1]), {}, scenes([1, 1]))
    text = card_text(replace(card, recovery=Recovery(None, 0, 6, 22 / 6)))
    assert "no (median); 0 of 6 within 3.7 decisions on average" in text


def test_a_card_without_another_scene_to_show_has_no_recovery(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plans: list[ProbePlan] = []
    donors = recordings()
    monkeypatch.setattr(
        card_module,
        "lacking",
        lambda arm, *_, **__: "a camera" if arm.name == "distract:1" else None,
    )
    monkeypatch.setattr(card_module, "run_probe", lambda policy, plan, *_, **__: plans.append(plan))
    monkeypatch.setattr(card_module.EvaluationRun, "run", lambda run: None)
    ended = {
        EpisodeKey(record.task, record.episode): [record] for record in records("test", [1, 1])
    }
    monkeypatch.setattr(card_module, "ended_scenes", lambda *_: ended)
    plan = ProbePlan(None, donors[:1], donors, JOBS[:2], OfflineSettings(1, 2))
    options = RunOptions(base=make_choice_env)
    card = run_card(reader(TIME), plan, tmp_path, FACTS, RolloutSettings(), options)
    assert card.recovery is None
    assert card.notes[0] == "wrong scene first (distract:1) was left out: it needs a camera."
    assert all("distract:1" not in plan.arms for plan in plans)


def test_a_card_runs_every_arm_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    use_inline_envs(monkeypatch)
    policy, donors = reader(CONTENT), recordings()
    plan = ProbePlan(None, donors[:1], donors, JOBS[:2], OfflineSettings(1, 2))
    settings = RolloutSettings(max_steps=16, flow_steps=2, workers=1, max_batch=1)
    options = RunOptions(base=make_choice_env, show_progress=False)
    card = run_card(policy, plan, tmp_path, FACTS, settings, options)
    assert set(card.arms) == set(ARMS) - {"oracle frames"} and "oracle frames" in card.notes[0]
    assert card.recovery is not None and card.recovery.recordings == 1
    assert verify(tmp_path / "again" / "receipt.json")[0] == []
    references = {"floor": str(tmp_path / "online" / "drop-all")}
    again = run_card(policy, plan, tmp_path, FACTS, settings, options, references)
    assert again.arms == card.arms
    assert again.references == {"floor": card.arms["nothing remembered"].success}


def test_a_card_tells_memory_off_from_memoryless_and_takes_a_memoryless_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(card_module, "run_probe", lambda *_, **__: None)
    monkeypatch.setattr(card_module.EvaluationRun, "run", lambda run: None)
    models = {"memoryless": "present_modul", "wrong": "framesamp_modul"}

    def ended(folder: Path, plan: ProbePlan) -> dict[EpisodeKey, list[Any]]:
        outcomes = [0, 1] if folder.name in models else [1, 1]
        made = records("test", outcomes)
        named = [replace(one, model=models.get(folder.name, one.model)) for one in made]
        return {EpisodeKey(one.task, one.episode): [one] for one in named}

    monkeypatch.setattr(card_module, "ended_scenes", ended)
    donors = recordings()
    plan = ProbePlan(None, (), donors, JOBS[:2], OfflineSettings(1, 2))
    options = RunOptions(base=make_choice_env)
    arguments = (plan, tmp_path, FACTS, RolloutSettings(), options)
    alone = run_card(reader(TIME), *arguments)
    assert any("references={memoryless: <folder>}" in note for note in alone.notes)
    beside = run_card(reader(TIME), *arguments, {"memoryless": str(tmp_path / "memoryless")})
    assert not any("references=" in note for note in beside.notes)
    assert beside.references == {"memoryless": 0.5}
    assert "(a memoryless training 50 %)" in conclude_card(beside)
    assert "which is not a memoryless policy" in (tmp_path / "card.html").read_text()
    with pytest.raises(UserError, match="holds records of framesamp_modul, which has a memory"):
        run_card(reader(TIME), *arguments, {"memoryless": str(tmp_path / "wrong")})


@pytest.mark.parametrize("words", [["card", "--help"], ["twins", "-h"]])
def test_help_of_a_card_and_of_twins_is_that_of_a_probe(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["mme-vla probe", *words])
    with pytest.raises(SystemExit) as ended:
        probe_command.main()
    assert ended.value.code == 0
    assert capsys.readouterr().out.startswith("Usage: mme-vla probe")
