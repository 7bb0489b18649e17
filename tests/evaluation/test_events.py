"""Events in a rollout: what the environment does, what the policy observes, and what is recorded of
them.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from helpers.rollout_fakes import (
    FACTS,
    JOBS,
    InlineEnvs,
    quick_policy,
    records,
    roll,
    save_records,
    use_inline_envs,
)
from helpers.scripted_env import VIDEO, make_moving_env, make_slow_env
from mme_vla import MMEPolicy, Perturbation, UserError, build_policy, register
from mme_vla.cli.results import main as results
from mme_vla.config.composition import compose
from mme_vla.envs.base import Environment, EpisodeEnv, Hold, environment
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.curves import distinct_parts
from mme_vla.evaluation.results.events import (
    event_curves,
    event_table,
    idle_events,
    matched_methods,
)
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.statistics import Interval, wilson
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions
from mme_vla.evaluation.rollout.events import EventCourse, event_arms, read_events
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.training_identity import TrainingIdentity
from mme_vla.processing.normalise import NormStats
from mme_vla.registry import PERTURBATIONS
from mme_vla.testing.small import cached_history

UNMASK, START = Job("VideoUnmask", "test", 0), VIDEO["VideoUnmask"]


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return quick_policy("framesamp_modul", 8, policy={"history_dtype": "float32"})


@pytest.fixture(scope="module")
def memoryless() -> MMEPolicy:
    return quick_policy("pi05")


class Observed:
    """What the policy knew at each decision: frames observed, the memory's selection, the current
    image.
    """

    def __init__(self, policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
        self.frames: list[int] = []
        self.selections: list[Any] = []
        self.images: list[torch.Tensor] = []
        act = policy.act

        def watched(episodes: Any, *args: Any) -> Any:
            for episode in episodes:
                self.frames.append(episode.n_observed_frames)
                self.selections.append(
                    episode.gather_selection() if episode.history is not None else None
                )
                self.images.append(episode.images.clone())
            return act(episodes, *args)

        monkeypatch.setattr(policy, "act", watched)


def facts(record: EpisodeRecord) -> tuple[Any, ...]:
    return record.outcome, record.steps, record.chunks, record.actions_sha256


def test_events_are_read_from_one_word() -> None:
    first, second = read_events("pause:100@subtask:2+gap:32@step:64")
    assert (first.perturbation.hold, first.perturbation.observed, first.unit, first.number) == (
        100,
        100,
        "subtask",
        2,
    )
    assert (second.perturbation.hold, second.perturbation.observed, second.unit, second.number) == (
        33,
        1,
        "step",
        64,
    )
    (start,) = read_events("pause:5")
    assert start.reached(0, 0) and not first.reached(99, 1) and first.reached(0, 3)
    assert read_events(None) == () and event_arms(["pause:1", "pause:2"]) == ["pause:1", "pause:2"]
    words = ("event=pause:100@subtask:2", "event=[pause:50,speed:0.5,restart@step:64+gap:3]")
    arms = [event_arms(compose("evaluate", [word]).event) for word in words]
    assert arms == [["pause:100@subtask:2"], ["pause:50", "speed:0.5", "restart@step:64+gap:3"]]


@pytest.mark.parametrize(
    ("arm", "words"),
    [
        ("pause:-5", "event=pause:-5: pause.frames=-5 must be a whole number, 0 or more"),
        ("pause:1.5", "event=pause:1.5: pause.frames=1.5"),
        ("gap:-1", "event=gap:-1: gap.frames=-1"),
        ("paus:5", "event=paus:5: name='paus'. Did you mean 'pause'"),
        ("pause:5@subtsk:2", "event=pause:5@subtsk:2: place='subtsk'.*subtask"),
        ("pause:5@subtask:pick", "event=pause:5@subtask:pick: write pause:100"),
        ("pause:5@subtask:0", "subtask:0 must be 1 or more"),
        ("pause:5@step:-1", "step:-1 must be 0 or more"),
        ("speed:2@step:4", "takes no place"),
        ("restart:4", "takes no number"),
        ("speed:0", "event=speed:0: speed.factor=0"),
        ("5", "event=5: write pause:100"),
        (["pause:5", "pause:5"], "each once"),
        (7, "event=7"),
        ("shuffle", "event=shuffle: shuffle changes nothing here; it belongs in with=…"),
        ("noise:1", "it belongs in data.history_transforms=… or with=…"),
    ],
)
def test_what_is_no_event_is_refused_with_its_key(arm: Any, words: str) -> None:
    with pytest.raises(UserError, match=words) as caught:
        event_arms(arm)
    assert str(caught.value).startswith("event=")


def test_events_of_no_length_equal_the_baseline_run_to_the_last_bit(policy: MMEPolicy) -> None:
    jobs = JOBS[2:4]
    made = [
        {
            r.key: facts(r)
            for r in roll(
                policy, jobs, InlineEnvs(2, base=make_moving_env), max_batch=1, event=event
            )
        }
        for event in (None, "pause:0@step:16+gap:0@subtask:3", "speed:1")
    ]
    assert len(made[0]) == 2 and all(other == made[0] for other in made)


def test_a_pause_holds_the_robot_and_memory_receives_its_frames(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    observed, envs = Observed(policy, monkeypatch), InlineEnvs()
    (record,) = roll(policy, [UNMASK], envs, event="pause:10@step:16")
    (again,) = roll(policy, [UNMASK], InlineEnvs(), event="pause:10@step:16")
    assert observed.frames[:3] == [START + 1, START + 27, START + 43]
    env = envs.made[UNMASK]
    assert env.hold_steps == 10 and len(env.actions) == 41, "the limit grows by the pause"
    assert (record.outcome, record.steps) == ("timeout", 51) and facts(again) == facts(record)
    assert record.events == ({"event": "pause:10@step:16", "step": 16},)
    frames = np.stack(env.frames)
    for count, selection in zip(observed.frames[:3], observed.selections, strict=False):
        offline = policy.require_memory().gather_selection(
            cached_history(policy, frames, exec_start=START), count - 1
        )
        assert torch.equal(selection.positions, offline.positions)
        assert torch.allclose(selection.features, offline.features, atol=1e-5)


def test_frames_of_a_gap_are_not_observed(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    observed, envs = Observed(policy, monkeypatch), InlineEnvs()
    roll(policy, [UNMASK], envs, event="gap:10@step:16")
    env = envs.made[UNMASK]
    assert env.hold_steps == 11 and observed.frames == [START + 1, START + 18, START + 34]
    frames = np.delete(np.stack(env.frames), np.arange(START + 17, START + 27), axis=0)
    for count, selection, images in zip(
        observed.frames, observed.selections, observed.images, strict=True
    ):
        front = frames[count - 1]
        assert torch.equal(images, policy.require_processor().images([front, front[::-1]]))
        offline = policy.require_memory().gather_selection(
            cached_history(policy, frames, exec_start=START), count - 1
        )
        assert torch.allclose(selection.features, offline.features, atol=1e-5)


def test_images_on_demand_are_all_that_a_policy_reads_under_events() -> None:
    policy = quick_policy("tokendrop_expert", 8, policy={"history_dtype": "float32"})
    event = "pause:5@step:16+gap:4@step:16+speed:2"
    few, every = (
        roll(policy, [UNMASK], InlineEnvs(), event=event, draw=draw)[0]
        for draw in ("needed", "all")
    )
    assert facts(few) == facts(every) and few.steps == 51


def test_a_video_can_be_faster_or_slower(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    for event, length in (("speed:2", 10), ("speed:0.5", 42)):
        observed = Observed(policy, monkeypatch)
        (record,) = roll(policy, [UNMASK], InlineEnvs(), event=event)
        assert observed.frames[0] == length + 1 and record.video_frames == length
        monkeypatch.undo()
    (no_video,) = roll(policy, [Job("PickXtimes", "test", 0)], InlineEnvs(), event="speed:2")
    assert no_video.events == ({"event": "speed:2", "step": None},)


@pytest.mark.parametrize("name", ["framesamp_modul", "ttt_modul", "framesamp_ttt_modul"])
def test_a_restart_begins_the_frame_index_anew_and_keeps_what_is_remembered(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = quick_policy(name, 8, policy={"history_dtype": "float32"})
    observed = Observed(policy, monkeypatch)
    (record,) = roll(policy, [UNMASK], InlineEnvs(), event="restart@step:16")
    assert record.events == ({"event": "restart@step:16", "step": 16},)
    assert [int(selection.step) for selection in observed.selections] == [START, 0, 16]
    last = observed.selections[2]
    times = last.positions[last.mask][:, 0]
    assert times.max() > 16 and (times == 16).any() and times.max() < START + 16
    monkeypatch.undo()
    baseline = Observed(policy, monkeypatch)
    roll(policy, [UNMASK], InlineEnvs())
    assert torch.equal(observed.selections[1].features, baseline.selections[1].features)
    assert not torch.equal(observed.selections[1].positions, baseline.selections[1].positions)


def test_a_policy_whose_frames_have_no_numbers_cannot_restart(
    memoryless: MMEPolicy, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="no memory that numbers frames"):
        EvaluationRun(memoryless, JOBS, tmp_path, FACTS, RolloutSettings()).run_with_events(
            ["restart@step:4"]
        )


def test_events_act_by_sub_task_and_episode_by_episode(memoryless: MMEPolicy) -> None:
    envs = InlineEnvs(6)
    made = roll(memoryless, JOBS, envs, event="pause:7@subtask:20+pause:3@subtask:20")
    assert {env.hold_steps for env in envs.made.values()} == {10}
    # the first decision in it
    assert [entry["step"] for r in made for entry in r.events] == [32] * 12
    alone = roll(
        memoryless, JOBS, InlineEnvs(1), event="pause:7@subtask:20+pause:3@subtask:20", max_batch=1
    )
    assert {(r.key, r.outcome, r.steps) for r in alone} == {
        (r.key, r.outcome, r.steps) for r in made
    }
    (never,) = roll(memoryless, [UNMASK], InlineEnvs(), event="pause:7@subtask:99")
    assert never.events == ({"event": "pause:7@subtask:99", "step": None},) and never.steps == 41


def test_a_place_that_the_environment_does_not_tell_is_refused() -> None:
    with pytest.raises(
        UserError, match="event=pause:1@subtask:1: this environment reports no sub-tasks"
    ):
        EventCourse(read_events("pause:1@subtask:1")).next(Any, step=0, subtask=0)  # type: ignore[arg-type]


def test_a_custom_event_is_registered_by_name(policy: MMEPolicy) -> None:
    @register("event", "rename")
    class Rename(Perturbation):
        hold, observed = 8, 5

        def act(self, episode: Any) -> None:
            episode.goal = "do something else"

    assert PERTURBATIONS["rename"] is Rename
    few, every = (
        roll(policy, [UNMASK], InlineEnvs(), event="rename@step:10", draw=d)[0]
        for d in ("needed", "all")
    )
    assert few.goal == "do something else" and few.events[0]["step"] == 16
    assert facts(few) == facts(every) and few.steps == 49


class Rail(gymnasium.Env[Any, Any]):
    """A cart that is pushed by its action, and a lamp that keeps blinking."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        self.place, self.time = 0.0, 0
        return self._frame(), {"goal": "stay"}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place, self.time = self.place + float(action[0]), self.time + 1
        return self._frame(), 0.0, False, False, {}

    def _frame(self) -> dict[str, np.ndarray]:
        return {
            "front": np.full((8, 8, 3), self.time, np.uint8),
            "state": np.array([self.place], np.float32),
        }


class Rails(Environment):
    tasks = ("Rail",)

    def make(self, spec: EpisodeSpec, render: bool = True) -> Rail:
        return Rail()


def test_a_custom_environment_names_the_action_that_keeps_its_robot() -> None:
    class Braked(Rails):
        def hold(self, env: Rail) -> np.ndarray:
            return np.zeros(1)

    spec = EpisodeSpec("Rail", "test", 0, 0, "")
    env = EpisodeEnv(Braked(), Rail(), spec, max_steps=3)
    env.reset()
    env.step(np.ones(1))
    observation, _, _, truncated, _ = env.step(Hold(5))
    assert [state.item() for state in observation["state_list"]] == [1.0] * 5 and not truncated
    assert [image[0, 0, 0] for image in observation["front_rgb_list"]] == [2, 3, 4, 5, 6]
    assert [env.step(np.ones(1))[3] for _ in range(2)] == [False, True], (
        "three actions and five steps of the pause"
    )
    assert env.oracle() is None, "this environment has no script"
    Braked().check_hold()
    with pytest.raises(UserError, match=r"Rails cannot pause, as .*: implement hold"):
        Rails().check_hold()


def test_an_event_that_the_environment_cannot_take_is_refused_before_the_plain_run(
    memoryless: MMEPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)

    def refuse(source: Any) -> None:
        raise UserError("it cannot pause")

    monkeypatch.setattr(type(environment("mme_vla")), "check_hold", refuse)
    options = RunOptions(base=make_slow_env, show_progress=False)
    run = EvaluationRun(memoryless, JOBS[:1], tmp_path, FACTS, RolloutSettings(), options)
    with pytest.raises(UserError, match="it cannot pause"):
        run.run_with_events(["pause:9"])
    assert not list(tmp_path.iterdir())


def test_every_event_run_has_its_matched_arm(
    memoryless: MMEPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    settings = RolloutSettings(max_steps=24, flow_steps=2, workers=2, max_batch=1)
    jobs = JOBS[2:4]
    options = RunOptions(base=make_slow_env, show_progress=False)
    done = EvaluationRun(memoryless, jobs, tmp_path, FACTS, settings, options).run_with_events(
        ["pause:9@subtask:30", "pause:9"]
    )
    assert [r.event for r in done.records] == ["pause:9@subtask:30"] * 2 + ["pause:9"] * 2
    baseline = {r.key: facts(r) for r in done.matched}
    assert all(facts(r) == baseline[r.key] for r in done.records[:2]), (
        "its sub-task never began: the same run"
    )
    assert all(
        r.steps != baseline[r.key][1] or facts(r) != baseline[r.key] for r in done.records[2:]
    )
    run = EvaluationRun(memoryless, jobs, tmp_path, FACTS, settings, options)
    again = run.run_with_events(["pause:9"])
    assert again.workload.chunks == 0 and [facts(r) for r in again.records] == [
        facts(r) for r in done.records[2:]
    ]
    protocol = Protocol(("VideoUnmask", "PickXtimes"), episodes=3)
    methods = aggregate([*done.records, *done.matched], protocol).methods
    assert [method.label for method in methods] == [
        "tiny · pause:9@subtask:30",
        "tiny · pause:9",
        "tiny",
    ]


def under(event: str | None, won: list[int], log: Any = ()) -> list[EpisodeRecord]:
    return [replace(r, event=event, events=tuple(log)) for r in records("test", won)]


def test_results_pair_events_with_their_matched_arms(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    never = [{"event": "pause:50@subtask:9", "step": None}]
    made = [
        *under(None, [1, 1, 1, 0]), *under("pause:50", [1, 0, 0, 1]), *under("pause:100", [0, 0]),
        *under("speed:2", [1, 0]), *under("pause:50@subtask:9", [1, 1, 1, 0], never),
    ]  # fmt: skip
    rows = {row[1]: row[3:] for row in event_table(made).rows}
    assert rows["pause:50"] == ["1", "4", "75.0", "50.0", "1", "2", "1", "1.000", "0"]
    assert idle_events(made) == [
        "event=pause:50@subtask:9 did not act in 4 episodes: its place never came."
    ]
    assert rows["pause:50@subtask:9"][-1] == "4" and rows["speed:2"][:4] == [
        "1",
        "2",
        "100.0",
        "50.0",
    ]
    curves = {
        dial: [(at, p.won, p.episodes) for at, p in points.items()]
        for (_, _, dial), points in event_curves(made).items()
    }
    assert curves["pause"] == [(0, 2, 2), (50, 1, 2), (100, 0, 2)] and curves["speed"] == [
        (1, 2, 2),
        (2, 1, 2),
    ]
    pairs = matched_methods(aggregate(made, Protocol(("PickXtimes",), episodes=2)))
    assert {(first.key.event, second.key.event) for first, second in pairs} == {
        (event, None) for event in ("pause:50", "pause:100", "speed:2", "pause:50@subtask:9")
    }
    save_records(tmp_path, made)
    page = tmp_path / "page.html"
    results([str(tmp_path), "--events", "--html", str(page)])
    assert (
        "Events beside their matched arms" in capsys.readouterr().out
        and "PickXtimes, pause" in page.read_text()
    )
    with pytest.raises(UserError, match="None of these records is of an event"):
        event_table(records("test", [1]))


def failing(record: EpisodeRecord) -> EpisodeRecord:
    never: Any = ({"event": "pause:50", "step": None},)
    return replace(record, outcome="error", error="x", events=never)


def test_errors_are_failures_in_table_and_curve_unless_they_are_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, *others = under("pause:50", [1, 1, 0, 0])
    made = [*under(None, [1, 1, 1, 0]), failing(first), *others]
    (row,) = event_table(made).rows
    assert row[4:] == ["4", "75.0", "25.0", "1", "2", "0", "0.500", "0"]
    (points,) = event_curves(made).values()
    assert [(p.won, p.episodes) for p in points.values()] == [(3, 4), (1, 4)]

    save_records(tmp_path, made)
    page = tmp_path / "page.md"
    results([str(tmp_path), "--events", "--markdown", str(page)])
    assert "| 4 | 75.0 | 25.0 |" in page.read_text()
    assert "1 episode ended in an error, which counts as a failure." in capsys.readouterr().out
    results([str(tmp_path), "--events", "--errors", "missing", "--markdown", str(page)])
    text = page.read_text()
    assert "| 3 | 66.7 | 33.3 |" in text and "| pause | 50 | 3 | 33.3 |" in text
    assert "error" not in capsys.readouterr().out


def test_a_rate_of_several_tasks_under_an_event_is_their_mean() -> None:
    made = []
    for event, won in ((None, [1, 1, 1, 1]), ("pause:50", [0, 0, 0, 1])):
        of_task = under(event, won)
        made += [replace(record, task="StopCube") for record in of_task[:3]] + of_task[3:]
    row = event_table(made).rows[-1]
    assert (row[2], row[5], row[6]) == ("all", "100.0", "50.0")


def test_a_view_takes_the_tasks_episodes_and_split_that_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = []
    for event, won in ((None, [1, 1, 1, 1]), ("pause:50", [1, 0, 0, 0])):
        of_event = under(event, won)
        made += [*of_event, *(replace(record, task="StopCube") for record in of_event)]
        made += [replace(record, split="val", seed=9) for record in of_event]
    save_records(tmp_path, made)
    page = tmp_path / "page.md"

    def rows(*words: str) -> list[list[str]]:
        results([str(tmp_path), "--events", "--markdown", str(page), *words])
        table = page.read_text().partition("### Success")[0]
        cells = [line.split(" | ") for line in table.splitlines() if "pause:50" in line]
        return [[row[0].rpartition(", ")[2], *row[2:7]] for row in cells]

    assert rows("--split", "val") == [["val", "PickXtimes", "1", "4", "100.0", "25.0"]]
    words = "--split", "test", "--tasks", "StopCube", "--episodes", "0-1"
    assert rows(*words) == [["test", "StopCube", "1", "2", "100.0", "50.0"]]
    capsys.readouterr()
    for wrong, message in (
        ("--events --tasks StopCub", "no task 'StopCub'"),
        ("--events --all --brief", "--all and --brief: not with --events"),
        ("--stress --split val", "--split: not with --stress"),
    ):
        with pytest.raises(SystemExit):
            results([str(tmp_path), *wrong.split()])
        assert message in capsys.readouterr().err


def test_a_matched_arm_of_another_step_limit_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shorter = [replace(record, max_steps=50) for record in under("pause:50", [0, 0])]
    save_records(tmp_path, [*under(None, [1, 1]), *shorter])
    results([str(tmp_path), "--events"])
    assert "Step limits differ: 1300 in m, " in capsys.readouterr().out


def test_an_event_without_its_matched_arm_is_named() -> None:
    made = [*under("pause:50", [1, 0]), *under(None, [1, 0]), *under("gap:4", [0, 1])]
    lonely = [replace(record, model="lonely") for record in under("pause:50", [1, 1])]
    notes = event_table([*made, *lonely]).notes
    assert [note for note in notes if "is not here" in note] == [
        "lonely, checkpoint 1, seed 7, test, event pause:50: left out of the pairs, for the same"
        " run without it is not here."
    ]


def test_trainings_of_a_recipe_are_one_row_and_one_curve() -> None:
    won = {None: ([1, 1, 1, 1], [1, 1, 0, 0]), "pause:64": ([0, 0, 0, 1], [1, 0, 1, 0])}
    made = [
        replace(record, training=TrainingIdentity(seed, "recipe", "data", f"w{seed}"))
        for event, outcomes in won.items()
        for seed, part in enumerate(outcomes)
        for record in under(event, part)
    ]
    (row,) = event_table(made).rows
    assert row[2:] == [
        "PickXtimes",
        "2",
        "8",
        "75.0 ± 35.4",
        "37.5 ± 17.7",
        "2",
        "4",
        "1",
        "0.500",
        "0",
    ]
    assert row[0] == "m, recipe recipe, checkpoint 1, seed 7, test"
    (points,) = event_curves(made).values()
    assert [(at, p.won, p.episodes) for at, p in points.items()] == [(0, 6, 8), (64, 3, 8)]
    assert distinct_parts(["m, recipe a, seed 7", "m, recipe b, seed 7"]) == [
        "recipe a",
        "recipe b",
    ]
    assert distinct_parts(["m, recipe a, seed 7"]) == ["m"]
    assert points[0].interval == Interval(*(100 * bound for bound in wilson(0.75, 4, 0.95))), (
        "of four scenes"
    )
    # A training without some of the event's episodes counts at no place with these.
    (points,) = event_curves(made[:-2]).values()
    assert [(at, p.episodes) for at, p in points.items()] == [(0, 6), (64, 6)]
    # As in the table: a mean over trainings, whatever their numbers of episodes.
    assert event_table(made[:-2]).rows[0][5:7] == ["100.0 ± 0.0", "37.5 ± 17.7"]
    assert [p.rate for p in points.values()] == [100.0, 37.5]


@pytest.mark.slow
def test_a_robot_that_chooses_stands_still_before_its_next_motion_in_a_sub_task(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An episode of the benchmark, by its own script, without images, cut after the motion that
    follows the pause.
    """
    pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")
    from mme_vla.envs.interface import RoboMMEEnv
    from mme_vla.extras.trajectories.rollouts import rollouts

    built = build_policy(
        "framesamp_modul",
        backbone="nano_choice",
        embodiment="robomme_choice_front",
        memory={"budget": 4, "grid": 1},
    )
    built.require_processor().stats = NormStats.unit(8, 10)
    holds: list[tuple[int, int, float]] = []
    hold = RoboMMEEnv._hold

    def watched(env: RoboMMEEnv, run: Any, steps: int) -> None:
        before, count = np.array(env.task.qpos), run.count
        hold(env, run, steps)
        holds.append(
            (
                env.task.progress.index,
                run.count - count,
                float(np.abs(env.task.qpos - before)[:7].max()),
            )
        )

    monkeypatch.setattr(RoboMMEEnv, "_hold", watched)
    how: dict[str, Any] = {
        "oracle_share": 1.0,
        "render": False,
        "max_steps": 150,
        "event": "pause:30@subtask:2",
    }
    (paused,) = rollouts(built.eval(), "mme_vla", [Job("PickXtimes", "test", 0)], (), **how)
    ((subtask, steps, motion),) = holds
    assert paused.outcome == "timeout" and paused.steps > 150
    assert (subtask, steps) == (1, 30) and motion < 0.05


@pytest.mark.parametrize(
    "text",
    [
        "pause:.",
        "pause:1.2.3",
        "pause:-",
        "pause:" + "9" * 5000,
        "restart@step:" + "9" * 5000,
        "pause:٥",
    ],
    ids=["point", "points", "sign", "digits", "digits of a place", "digits of another script"],
)
def test_a_number_that_cannot_be_read_is_refused_as_another_form(text: str) -> None:
    with pytest.raises(UserError, match="write pause:100"):
        read_events(text)
