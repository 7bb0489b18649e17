"""One policy for several tasks: its floors, the scenes it sees, and the command from a fresh
process.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import DictConfig

from mme_vla import build_policy
from mme_vla.config.composition import compose, resolved
from mme_vla.data.waypoints import Motions
from mme_vla.embodiment.action_space import Option
from mme_vla.envs import metadata
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.rollout.environment import Report
from mme_vla.evaluation.rollout.running import RunningEpisode
from mme_vla.extras.nano import evaluating
from mme_vla.extras.nano.cli.nano import with_settings
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.extras.nano.evaluating import Rules, built_scenes, frequent_moves, play_all
from mme_vla.extras.nano.learning import Decisions, choice_errors, statistics
from mme_vla.extras.nano.rows import read_rows
from mme_vla.extras.nano.runs import compose_rows
from mme_vla.extras.nano.settings import NanoRun
from mme_vla.policy.mme import MMEPolicy


def policy(model: str, **others: object) -> MMEPolicy:
    robot = {
        "backbone": "nano_choice",
        "embodiment": "robomme_choice_front",
        "backbone.head.temperature": 0,
    }
    return build_policy(model, policy={"augment": False}, **robot, **others)


def demonstration_of(letters: str, task: str = "StopCube") -> Demonstration:
    """A demonstration of these choices, b with a point."""
    targets = np.zeros((len(letters), 10), np.float32)
    targets[:, 8:] = 0.5
    for row, letter in zip(targets, letters, strict=True):
        row["abcdefgh".index(letter)] = 1
        row[8:] = (0.25, 0.75) if letter == "b" else (0.5, 0.5)
    rng = np.random.default_rng(0)
    frames = np.arange(len(letters)) * 4
    images = {int(frame): rng.integers(0, 256, (256, 256, 3), dtype=np.uint8) for frame in frames}
    states = rng.uniform(-1, 1, (40, 8)).astype(np.float32)
    goal = "press it. Options: a wait, b go (point)"
    return Demonstration(task, 0, "easy", goal, 40, 0, states, Motions(frames, targets),
                         {"front": images}, np.array([0]))  # fmt: skip


def test_present_gives_the_current_frame_and_as_many_parameters_as_a_memory() -> None:
    present = policy("present_modul", memory={"grid": 4})
    remembering = policy("framesamp_modul", memory={"budget": 16})
    counts = [sum(p.numel() for p in part.parameters()) for part in (present, remembering)]
    assert counts[0] == counts[1] and present.require_memory().budget == 16
    assert present.frames_read(np.array([3, 9]), 0).tolist() == [3, 9]
    made = demonstration_of("ab")
    present.require_processor().stats = statistics([made], present)
    history = Decisions.of(present, [made]).batch.history
    assert history is not None and history.positions[:, :, 0].float().std(1).max() == 0


def nano_run(cfg: DictConfig) -> NanoRun:
    return NanoRun.from_config(resolved(cfg))


@pytest.mark.nightly
def test_all_memories_read_decisions_and_the_same_frames() -> None:
    rows = compose_rows(nano_run(compose("nano", ["nano=nano16"])))
    decisions = np.array([66, 71, 140, 333, 640, 1201])
    stored, every = {0, *range(15, 1300, 16)}, set[int]()
    for choice in rows.choices:
        read = choice.read(decisions, 66)
        assert read <= stored | set(decisions.tolist()), choice.memory
        every |= read
    assert {choice.memory["name"] for choice in rows.choices if choice.memory} == {
        "framesamp",
        "tokendrop",
        "ttt",
        "rmt",
        "present",
        "retrieval",
        "gist",
        "moment",
        "actions",
        "learned_topk",
        "bank",
        "anchors",
        "events",
        "pyramid",
        "keyframes",
    }
    of_one = compose_rows(
        nano_run(compose("nano", ["nano=nano16", "with_memory=framesamp_modul", "also=[]"]))
    )
    assert every == set().union(*(choice.read(decisions, 66) for choice in of_one.choices)), (
        "later rows render none"
    )


def test_planned_motions_of_several_tasks_are_one_run() -> None:
    config = resolved(compose("nano", ["nano=motions"]))
    rows = compose_rows(NanoRun.from_config(config))
    assert (
        rows.robot.action.answers == "waypoint"
        and rows.blind == "pi05"
        and len(config["task"]) == 5
    )
    assert {each["backbone"]["name"] for each in rows.composed.values()} == {"nano"}


def test_backbone_and_embodiment_are_chosen_on_the_command_line() -> None:
    config = compose(
        "nano", with_settings(["embodiment=robomme_waypoint_front_route", "backbone=nano_choice"])
    )
    assert (config.with_embodiment, config.with_backbone) == (
        "robomme_waypoint_front_route",
        "nano_choice",
    )


def test_mirrored_places_of_motions_are_refused_before_anything_is_recorded() -> None:
    one = ["with_memory=framesamp_modul", "beside=[]", "also=[]", "rendered_for=[]"]
    with pytest.raises(UserError, match=r"learning\.reflect=0\.5 needs a point"):
        compose_rows(nano_run(compose("nano", ["nano=motions", "learning.reflect=0.5", *one])))
    with pytest.raises(UserError, match=r"backbone=nano_choice"):
        compose_rows(
            nano_run(compose("nano", ["nano=nano16", "with_backbone=tiny", "overrides=[]", *one]))
        )


def test_errors_of_choices_are_counted_by_task(monkeypatch: pytest.MonkeyPatch) -> None:
    blind, demonstrations = (
        policy("pi05").eval(),
        [demonstration_of("abb"), demonstration_of("ab", "BinFill")],
    )
    blind.require_processor().stats = statistics(demonstrations, blind)
    decisions = Decisions.of(blind, demonstrations)
    assert decisions.batch.actions is not None
    wrong = decisions.batch.actions.clone()
    wrong[1, 0, :8] = wrong[0, 0, :8]
    wrong[2, 0, 8:] = wrong[0, 0, 8:]  # the middle of the image
    monkeypatch.setattr(blind, "sample_actions", lambda *_: wrong)
    errors = choice_errors(blind, decisions)
    assert errors.accuracy == {
        "StopCube": pytest.approx(2 / 3),
        "BinFill": 1,
    } and errors.off_by == pytest.approx(0)
    assert errors.points == {"StopCube": 0.5, "BinFill": 1}


def test_frequent_moves_are_those_of_most_demonstrations_at_each_place(tmp_path: Path) -> None:
    files = [tmp_path / f"{number}.npz" for number in range(3)]
    for file, letters in zip(files, ("ab", "ab", "b"), strict=True):
        demonstration_of(letters).save(file)
    (moves,) = frequent_moves(files, policy("pi05").embodiment.action).values()
    assert [move["choice"] for move in moves] == ["a", "b"] and moves[1]["point"] == pytest.approx(
        [63.75, 191.25], abs=1
    )


def test_what_is_not_possible_is_listed_and_not_selected() -> None:
    space = policy("pi05").embodiment.action
    options = (Option("a", "press"), Option("b", "pick up", True, possible=False))
    scores = np.zeros((1, 10), np.float32)
    scores[0, 1] = 1
    assert space.decide(torch.from_numpy(scores), options)[0, :2].tolist() == [1, 0]
    assert "b pick up" in space.worded("do it", options)


def test_what_is_possible_is_queried_again_after_each_choice() -> None:
    def report(possible: bool) -> Report:
        press = {"label": "a", "action": "press", "need_parameter": False}
        options = [
            {"label": "b", "action": "pick up", "need_parameter": False, "possible": possible},
            press,
        ]
        return Report(goal="do it", options=options, executed=1, frames=1)

    frames = {"state": np.zeros((1, 8), np.float32), "front": [np.zeros((256, 256, 3), np.uint8)]}
    running = RunningEpisode(policy("pi05"), Job("StopCube", "test", 0), 0, None, 32, None)
    running.take_report(report(False))
    running.begin(frames)
    assert not running.episode.options[0].possible
    running.take_report(report(True))
    running.resume(frames)
    assert running.episode.options[0].possible


def test_scenes_that_cannot_be_built_are_replaced_and_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def scene(spec: metadata.EpisodeSpec) -> tuple[str, str]:
        tried.append(spec.episode)
        return f"{spec.task} {spec.episode}", "no place" if spec.episode == 1 else ""

    monkeypatch.setattr(evaluating, "tried_scene", scene)
    for _ in range(2):
        specs, left_out = built_scenes(
            tmp_path / "scenes.json", ["StopCube", "BinFill"], "reserved", 3, 1
        )
        assert [(spec.task, spec.episode) for spec in specs[:3]] == [
            ("StopCube", 0),
            ("StopCube", 2),
            ("StopCube", 3),
        ]
        assert left_out == ["BinFill 1: no place", "StopCube 1: no place"] and sorted(tried) == [
            0,
            0,
            1,
            1,
            2,
            2,
            3,
            3,
        ]


def test_reserved_scenes_are_in_no_other_split() -> None:
    seeds = {
        spec.seed for task in metadata.TASK_NAMES for spec in metadata.episodes(task, "reserved")
    }
    assert min(seeds) == 5_010_000 and max(seeds) < 6_000_000
    others = {
        spec.seed
        for split in ("train", "val", "test", "further", "further_hard", "more", "challenge")
        for spec in metadata.episodes("BinFill", split)
    }
    assert not seeds & others


def test_floors_and_ceilings_are_played_and_resumed(tmp_path: Path) -> None:
    pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")
    specs = [metadata.episode("VideoUnmask", "val", 0)]
    rules = Rules("val", max_choices=2, only_possible=True)
    (record,) = play_all("demonstrator", tmp_path / "demonstrator", specs, rules, {})
    assert (record.model, record.outcome, record.action_space) == (
        "demonstrator",
        "success",
        "multi_choice",
    )
    moves = {"VideoUnmask": [{"choice": "a", "point": [0.0, 0.0]}]}
    (record,) = play_all("frequent", tmp_path / "frequent", specs, rules, moves)
    assert record.outcome in ("success", "fail", "timeout") and record.error is None
    assert play_all("frequent", tmp_path / "frequent", specs, rules, moves) == [record]
    about = json.loads((tmp_path / "frequent" / "trained.json").read_text())
    assert (about["kind"], about["trained"], about.get("parameters")) == ("floor", False, None)


@pytest.mark.nightly
def test_the_command_learns_two_tasks_and_continues_in_a_fresh_process(
    tmp_path: Path, renderer: str
) -> None:
    words = [
        "nano=nano16",
        "task=[StopCube,MoveCube]",
        "model=framesamp_modul",
        "beside=[pi05]",
        "rendered_for=[]",
        "demonstrations={easy: 2, medium: 0, hard: 0}",
        "trainings=1",
        "train.batch_size=2",
        "train.steps=3",
        "split=val",
        "episodes=1",
        "max_choices=2",
        "workers=2",
        f"output={tmp_path}",
    ]
    for stage in ("train", "all", "all"):
        command = [sys.executable, "-m", "mme_vla.nano", *words, f"stage={stage}"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    rows = {
        path.parent.parent.name: json.loads(path.read_text())
        for path in tmp_path.glob("val/*/*/trained.json")
    }
    assert set(rows) == {
        "framesamp_modul",
        "oracle_frames",
        "pi05",
        "demonstrator",
        "random",
        "frequent",
    }
    oracle = {**rows["framesamp_modul"], "row": "oracle_frames", "kind": "ceiling"}
    assert rows["oracle_frames"] == oracle and len(read_rows([tmp_path / "val"])) == 6
    assert (
        rows["pi05"]["demonstrations"] == {"StopCube": 2, "MoveCube": 2}
        and rows["pi05"]["val_loss"] > 0
    )
    for row in tmp_path.glob("val/*/0"):
        assert len((row / "episodes.jsonl").read_text().splitlines()) == 2, row
        assert {"config.yaml", "run.json", "trained.json", "episodes.jsonl"} <= {
            path.name for path in row.iterdir()
        }
