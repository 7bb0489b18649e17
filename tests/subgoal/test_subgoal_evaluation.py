"""Predictors in rollouts: the log of every subgoal, its score, and predictors in the background."""

import json
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from helpers import commands
from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from mme_vla import UserError
from mme_vla.cli.evaluate import choose_subgoals
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.report import html_report
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.rollout.subgoals import (
    SubgoalScore,
    SubgoalTrace,
    point_distances,
    subgoal_tables,
    total_score,
)
from mme_vla.evaluation.store import read_records
from mme_vla.subgoal import BackgroundPredictor, Subgoal, SubgoalPredictor, build_predictor
from mme_vla.subgoal.text import points_of

UNMASK = Job("VideoUnmask", "test", 0)


class Shifted(SubgoalPredictor):
    """Says the scripted environment's grounded subgoal with its point moved, and from the third on
    other words.
    """

    def predict_due(self, episodes):
        message = []
        for episode in episodes:
            text = f"Push at <{episode.step + 3}, 13>." if episode.step < 32 else "pull"
            problem = "malformed" if episode.step == 16 else ""
            message.append(
                Subgoal(
                    text,
                    points_of(text),
                    queried=True,
                    reply=f"answer {episode.step}",
                    problem=problem,
                )
            )
        return message


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_every_subgoal_is_recorded_with_its_time_and_image(tmp_path: Path) -> None:
    policy, envs = quick_policy("groundsg"), InlineEnvs()
    (tmp_path / "VideoUnmask_ep0").mkdir()
    (tmp_path / "VideoUnmask_ep0" / "99999.jpg").touch()  # of a try that was cut off
    (record,) = roll(policy, [UNMASK], envs, Shifted(), subgoal_folder=tmp_path)
    records = lines(tmp_path / "VideoUnmask_ep0.jsonl")
    assert [line["step"] for line in records] == [0, 16, 32]
    assert [line["text"] for line in records] == ["Push at <3, 13>.", "Push at <19, 13>.", "pull"]
    assert [line["oracle"] for line in records] == [
        "push at <0, 9>",
        "push at <16, 9>",
        "push at <32, 9>",
    ]
    assert [line["answer"] for line in records] == ["answer 0", "answer 16", "answer 32"]
    assert [line["asked_step"] for line in records] == [0, 16, 32]
    assert all(line["asked"] and line["latency_s"] >= 0 for line in records)
    assert (
        0
        < records[0]["seconds"]
        < records[1]["seconds"]
        < records[2]["seconds"]
        < record.seconds.total
    )
    for line in records:
        image = np.asarray(Image.open(tmp_path / line["image"]), np.int64)
        frame = envs.made[UNMASK].frames[21 + line["step"]]  # 21 frames of video come before
        assert np.abs(image - frame).mean() < 2
    assert len(list((tmp_path / "VideoUnmask_ep0").iterdir())) == 3
    assert record.subgoals == {
        "chunks": 3,
        "judged": 3,
        "right": 2,
        "points": 2,
        "distance": 10.0,
        "asked": 3,
        "problems": {"malformed": 1},
    }


def test_the_oracle_is_always_right(tmp_path: Path) -> None:
    records = roll(
        quick_policy("groundsg"), [UNMASK], InlineEnvs(), build_predictor({"name": "oracle"})
    )
    score = total_score(records)
    assert score is not None
    assert (score.accuracy, score.mean_distance, score.asked, score.judged) == (100.0, 0.0, 0, 3)
    assert list(tmp_path.iterdir()) == [], "without a folder nothing is written"


def test_words_are_compared_without_points_case_and_full_stop() -> None:
    assert point_distances("Pick up the cube at <3, 4>.", "pick up  the cube at <0, 0>") == [5.0]
    assert point_distances("press the button", "press the button") == []
    for text in (
        None,
        "press the button",
        "pick up the cube",
        "pick up the cube at <3, 4> at <1, 1>",
    ):
        assert point_distances(text, "pick up the cube at <0, 0>") is None


def test_what_the_environment_does_not_name_is_not_judged() -> None:
    score = SubgoalScore()
    score.add("press the button", None)
    assert (score.chunks, score.judged, score.accuracy, score.mean_distance) == (1, 0, None, None)
    assert score.show() == ["–", "–"]
    score.add(None, "press the button")
    assert score.accuracy == 0


def test_results_tell_right_subgoals_and_distances_by_task() -> None:
    def record(task: str, right: int, problems: dict | None = None) -> EpisodeRecord:
        score = {
            "chunks": 4,
            "judged": 4,
            "right": right,
            "points": right,
            "distance": 3.0 * right,
            "asked": 4,
            "problems": problems or {},
        }
        place = ("groundsg", 1, 7, task, 0, 1, "easy", "success", 9)
        return EpisodeRecord(*place, subgoal="qwenvl", subgoals=score)

    protocol = Protocol(("PickXtimes", "VideoUnmask"), 1)
    results = aggregate([record("PickXtimes", 4), record("VideoUnmask", 1, {"empty": 2})], protocol)
    (table,) = subgoal_tables(results)
    assert table is not None and [row[:5] for row in table.rows] == [
        ["PickXtimes", "1", "4", "100.0", "3.0"],
        ["VideoUnmask", "1", "4", "25.0", "3.0"],
        ["all", "2", "8", "62.5", "3.0"],
    ]
    assert [row[-1] for row in table.rows] == ["0", "2 empty", "2 empty"]
    assert "subgoals beside the environment" in html_report(results, [], "t")
    broken = EpisodeRecord(
        "groundsg", 1, 7, "PickXtimes", 0, 1, "easy", "success", 9, subgoals={"right": 1}
    )
    with pytest.raises(UserError, match="not a score"):
        total_score([broken])


class Slow(SubgoalPredictor):
    """Returns only when released; keeps the queries."""

    def __init__(self, interval: int = 1) -> None:
        super().__init__("simple", interval)
        self.go, self.queries = threading.Semaphore(0), []
        self.error: Exception | None = None
        self.observed: list[int] = []

    def start_episode(self, goal, video=None, task=""):
        episode = super().start_episode(goal, video, task)
        observe = episode.observe
        episode.observe = lambda frames, info=None: (
            self.observed.extend(frames[:, 0, 0, 0].tolist()),
            observe(frames, info),
        )
        return episode

    def predict_due(self, episodes):
        self.queries.append([(episode.goal, episode.step) for episode in episodes])
        assert self.go.acquire(timeout=30)
        if self.error:
            raise self.error
        return [Subgoal(f"{episode.goal} {episode.step}", queried=True) for episode in episodes]


def frames(first: int, count: int) -> np.ndarray:
    return np.stack([np.full((8, 8, 3), first + i, np.uint8) for i in range(count)])


def settle(predictor: BackgroundPredictor) -> None:
    """Wait until the prediction under way is there."""
    assert predictor._prediction is not None
    predictor._prediction.exception(timeout=30)


def test_in_the_background_only_the_first_subgoal_is_waited_for() -> None:
    slow = Slow()
    predictor = BackgroundPredictor(slow)
    episode = predictor.start_episode("Go")
    episode.observe(frames(0, 1))
    slow.go.release()
    assert predictor.predict([episode]) == [Subgoal("go 0", queried=True)]
    episode.observe(frames(1, 16))
    assert predictor.predict([episode]) == [Subgoal("go 0")], (
        "the policy continues with the last one"
    )
    episode.observe(frames(17, 16))
    assert predictor.predict([episode]) == [Subgoal("go 0")]
    slow.go.release()
    settle(predictor)
    episode.observe(frames(33, 16))
    assert predictor.predict([episode]) == [Subgoal("go 16", queried=True)], (
        "the answer to the question at step 16"
    )
    slow.go.release()
    settle(predictor)
    assert slow.queries == [[("go", 0)], [("go", 16)], [("go", 48)]]
    assert slow.observed == list(range(49)), "every frame reached the predictor once, in order"
    predictor.close()


def test_a_question_that_came_due_while_the_thread_was_busy_is_queried_once_it_is_free() -> None:
    slow = Slow(interval=48)
    predictor = BackgroundPredictor(slow)
    first, second = predictor.start_episode("A"), predictor.start_episode("B")
    for episode in (first, second):
        episode.observe(frames(0, 1))
    slow.go.release()
    predictor.predict([first, second])
    for _ in range(3):
        first.observe(frames(0, 16))
    predictor.predict([first])  # asked at 48, and the thread stays busy
    for _ in range(4):
        second.observe(frames(0, 16))
    assert predictor.predict([second]) == [Subgoal("b 0")], "due since 48"
    slow.go.release(2)
    settle(predictor)
    predictor.predict([second])
    settle(predictor)
    assert slow.queries == [[("a", 0), ("b", 0)], [("a", 48)], [("b", 64)]]
    assert (
        predictor.predict([second]) == [Subgoal("b 64", queried=True)] and second.query_step == 64
    )
    predictor.close()


def test_a_failure_in_the_background_reaches_the_run() -> None:
    slow = Slow()
    predictor = BackgroundPredictor(slow)
    episode = predictor.start_episode("Go")
    episode.observe(frames(0, 1))
    slow.error = UserError("no such key")
    slow.go.release()
    with pytest.raises(UserError, match="no such key"):
        predictor.predict([episode])
    predictor.close()


def test_a_rollout_with_a_predictor_in_the_background_ends_like_any_other(tmp_path: Path) -> None:
    oracle = choose_subgoals(quick_policy("groundsg"), {"name": "oracle"}, "background")
    assert isinstance(oracle, BackgroundPredictor)
    jobs = [Job("PickXtimes", "test", episode) for episode in range(3)]
    records = roll(quick_policy("groundsg"), jobs, InlineEnvs(2), oracle, subgoal_folder=tmp_path)
    assert [record.outcome for record in records] == ["timeout"] * 3
    assert {record.subgoals["chunks"] for record in records} == {3}
    with pytest.raises(UserError, match="subgoal_mode='behind'"):
        choose_subgoals(quick_policy("groundsg"), {"name": "oracle"}, "behind")


def test_a_folder_left_by_another_process_does_not_stop_a_trace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "VideoUnmask_ep0").mkdir()
    monkeypatch.setattr("mme_vla.evaluation.rollout.subgoals.shutil.rmtree", lambda *_, **__: None)
    SubgoalTrace("simple", tmp_path, "VideoUnmask_ep0")
    assert (tmp_path / "VideoUnmask_ep0.jsonl").read_bytes() == b""


TINY_VLM = [
    "subgoal=qwenvl",
    "subgoal.model=tiny",
    "subgoal.device=cpu",
    "subgoal.max_new_tokens=8",
]


@pytest.mark.nightly
@pytest.mark.parametrize("words", [["subgoal=oracle"], TINY_VLM], ids=["oracle", "qwenvl"])
def test_the_command_drives_groundsg_by_a_predictor_on_two_tasks(
    words: list[str], tmp_path: Path
) -> None:
    pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")
    pytest.importorskip("transformers", reason="needs the extra vlm")
    from mme_vla.envs.rendering import render_backend

    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))
    tasks = [
        "model=groundsg",
        "backbone=tiny",
        "tasks=[PickXtimes,ButtonUnmask]",
        "episodes=1",
        "max_steps=24",
    ]
    done = commands.run(
        "mme_vla.evaluate", *tasks, *words, "video=all", "workers=2", f"output={tmp_path}"
    )
    assert done.returncode == 0, done.stderr
    records = read_records(tmp_path / "episodes.jsonl")
    assert sorted(record.task for record in records) == ["ButtonUnmask", "PickXtimes"]
    assert all((record.outcome, record.steps) == ("timeout", 25) for record in records), [
        r.error for r in records
    ]
    score = total_score(records)
    assert score is not None and (score.chunks, score.judged) == (4, 4)
    assert "right subgoals" in done.stdout and "points off by" in done.stdout
    for record in records:
        name = f"{record.task}_ep0"
        entries = lines(tmp_path / "subgoals" / f"{name}.jsonl")
        assert [line["step"] for line in entries] == [0, 16] and all(
            line["oracle"] for line in entries
        )
        assert Image.open(tmp_path / "subgoals" / entries[0]["image"]).size == (256, 256)
        assert (tmp_path / "videos" / record.video).stat().st_size > 1000
    if words[0] == "subgoal=oracle":
        assert score.accuracy == 100
        pick = next(line for line in lines(tmp_path / "subgoals" / "PickXtimes_ep0.jsonl"))
        assert pick["text"] == pick["oracle"] and len(pick["points"]) == 1
    else:
        assert score.asked == 3, "ButtonUnmask holds its first subgoal only once there is one"


def test_an_error_in_the_background_is_raised_once_and_the_next_question_is_answered() -> None:
    class Interrupted(SubgoalPredictor):
        broken = True

        def predict_due(self, episodes):
            if self.broken:
                self.broken = False
                raise UserError("the key is not accepted")
            return [Subgoal("go", queried=True) for _ in episodes]

    predictor = BackgroundPredictor(Interrupted())
    episode = predictor.start_episode("a")
    episode.observe(np.zeros((1, 8, 8, 3), np.uint8))
    with pytest.raises(UserError, match="key"):
        predictor.predict([episode])
    assert predictor.predict([episode]) == [Subgoal("go", queried=True)]
