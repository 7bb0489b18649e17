"""An episode as a sequence of choices, and the runs made of them, against a stand-in
environment.
"""

import json
from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.play_fakes import BLOCKS, MOTION, VIDEO, BlocksEnv, a_session, an_episode
from mme_vla.envs.grounding import project
from mme_vla.envs.subtasks import Choice
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.store import read_records
from mme_vla.extras.play import ChoiceSession, RandomPlayer
from mme_vla.extras.play.cli import _by_itself, line, print_summary
from mme_vla.extras.play.players import play
from mme_vla.extras.play.run import Identity, PlayRun


def press(name):
    return {"choice": "a", "point": list(BLOCKS[name])}


def test_the_video_comes_first_then_the_frames_of_each_motion():
    session = a_session()
    first = session.start()
    assert (first.title, len(first.frames), first.start) == ("Conditioning video", VIDEO + 1, 0)
    assert [(o.label, o.needs_point) for o in session.options] == [
        ("a", True),
        ("b", False),
        ("c", False),
    ]
    assert session.goal == "press the blocks in the order of the video"
    second = session.choose(press("blue"))
    assert (second.title, len(second.frames), second.start) == (
        "press the block",
        MOTION,
        VIDEO + 1,
    )
    assert session.frame is second.frames[-1]
    assert session.n_displayed_frames == VIDEO + 1 + MOTION
    assert session.steps == MOTION


def test_a_player_that_never_gets_on_is_timed_out():
    session = a_session(max_choices=3)
    session.start()
    for _ in range(3):
        session.choose({"choice": "b"})
    record = session.record("patient")
    assert (record.outcome, record.extra["ended_by"], record.steps) == ("timeout", "max_choices", 0)


def test_a_choice_that_moves_nothing_takes_a_step_of_the_limit():
    session = a_session(max_choices=None, max_steps=MOTION + 2)
    session.start()
    session.choose(press("blue"))
    for _ in range(2):
        session.choose({"choice": "b"})
    assert session.status == "ongoing"
    session.choose({"choice": "b"})
    record = session.record("patient")
    assert (record.outcome, record.extra["ended_by"]) == ("timeout", "max_steps")
    assert record.steps == MOTION


def test_what_no_motion_reaches_is_a_failure_as_in_an_evaluation():
    class OutOfReach(BlocksEnv):
        def step(self, action):
            info = {"error_message": "no path", "exception_type": "PlanningError"}
            return None, 0.0, True, False, {"status": "error", **info}

    session = ChoiceSession(OutOfReach(), an_episode())
    session.start()
    session.choose(press("blue"))
    record = session.record("human")
    assert (record.outcome, record.error, record.refused) == ("fail", None, "no path")


def test_an_error_of_the_planner_ends_the_episode_and_is_recorded():
    session = a_session()
    session.start()
    assert session.choose({"choice": "c"}).frames == []
    record = session.record("human")
    assert (record.outcome, record.error) == ("error", "no path")


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ({"choice": "z"}, "no option 'z'"),
        ({"point": [1, 2]}, "is no choice; expected"),
        ("a", "is no choice; expected"),
        ({"choice": "a"}, "needs a point: the pixel"),
        ({"choice": "a", "point": []}, "needs a point: the pixel"),
        ({"choice": "a", "point": [1, 2, 3]}, "needs two numbers"),
        ({"choice": "a", "point": ["x", 2]}, "needs two numbers"),
        ({"choice": "a", "point": [float("nan"), 2]}, "needs two numbers"),
        ({"choice": "a", "point": {"y": 1}}, "needs two numbers"),
        ({"choice": "a", "point": [256, 2]}, "lies outside of the image"),
        ({"choice": "a", "point": [5, -1]}, "lies outside of the image"),
    ],
)
def test_a_choice_that_cannot_be_made_is_refused_and_changes_nothing(action, message):
    session = a_session()
    session.start()
    with pytest.raises(UserError, match=message):
        session.choose(action)
    assert (session.env.received_actions, session.decisions, session.status) == ([], [], "ongoing")
    session.choose(press("blue"))
    assert len(session.decisions) == 1


def test_nothing_can_be_selected_before_the_start_and_recorded_before_the_end():
    session = a_session()
    with pytest.raises(UserError, match="before start"):
        session.choose(press("blue"))
    session.start()
    with pytest.raises(UserError, match="not over"):
        session.record("human")
    with pytest.raises(UserError, match="has begun"):
        session.start()


def test_the_objects_of_an_option_are_pixels_of_the_present_scene():
    cube = SimpleNamespace(position=np.array([0.0, 0.1, 0.02]))
    choices = [Choice("a", "pick", print, [cube]), Choice("b", "press", print)]
    session = a_session()
    assert session.objects() == {}, "it does not say where its objects are"
    session.env.task = SimpleNamespace(choices=lambda: choices)
    assert session.objects() == {"a": [tuple(project(cube.position))]}
    cube.position = np.array([0.1, 0.0, 0.02])
    assert session.objects() == {"a": [tuple(project(cube.position))]}


def test_an_environment_of_another_kind_is_refused():
    class Blind(BlocksEnv):
        def _observation(self, count):
            return {"joint_state_list": [np.zeros(7)] * count}

    class Other(BlocksEnv):
        def _info(self, status):
            return {"status": status}

    with pytest.raises(UserError, match="render=True"):
        ChoiceSession(Blind(), an_episode()).start()
    with pytest.raises(UserError, match="multi_choice"):
        ChoiceSession(Other(), an_episode()).start()
    blind = ChoiceSession(Blind(), an_episode(), images=False)
    assert len(blind.start().frames) == VIDEO + 1
    assert not blind.frame.any()


def test_the_record_holds_every_decision_and_survives_its_line():
    ticks = count()
    session = a_session(clock=lambda: next(ticks))
    session.start()
    session.choose(press("blue"), note={"answers": ["first"]})
    session.choose({"choice": "b"})
    session.choose(press("red"))
    record = EpisodeRecord.from_json(session.record("human", "anna", extra_key=1).to_json())
    assert (record.model, record.checkpoint, record.action_space) == (
        "human",
        "anna",
        "multi_choice",
    )
    assert (record.outcome, record.steps, record.seed, record.difficulty) == (
        "success",
        2 * MOTION,
        560000,
        "easy",
    )
    first, second, third = record.extra["decisions"]
    assert first["choice"] == "a"
    assert first["point"] == list(BLOCKS["blue"])
    assert first["frames"] == [VIDEO + 1, VIDEO + 1 + MOTION]
    assert first["note"] == {"answers": ["first"]}
    assert (second["point"], second["frames"][0] == second["frames"][1]) == (None, True)
    assert (first["status"], third["status"]) == ("ongoing", "success")
    assert (record.seconds.sim, record.seconds.policy) == (
        4,
        3,
    )  # a tick each: reset, three steps; three thoughts
    assert record.extra["extra_key"] == 1


def test_random_choices_depend_on_seed_and_episode_alone():
    def choices(seed, number, before=0):
        player = RandomPlayer(seed)
        for which in [*[9] * before, number]:
            session = a_session(which)
            session.start()
            player.start(session)
            sampled = [player.choose(session)[0] for _ in range(6)]
        return json.dumps(sampled)

    assert choices(0, 1) == choices(0, 1, before=2)
    assert len({choices(*which) for which in ((0, 1), (0, 2), (1, 1))}) == 3


# Runs ---------------------------------------------------------------------------------------------


def a_run(folder, numbers=range(2), **settings):
    identity = Identity("random", 0, 0, 1300, {"player": "random", **settings})
    return PlayRun(
        folder, [an_episode(n) for n in numbers], identity, lambda which: a_session(which.episode)
    )


def test_a_run_goes_on_where_it_stopped(tmp_path):
    with a_run(tmp_path) as run:
        assert [which.episode for which in run.todo] == [0, 1]
        run.save(play(run.make(run.todo[0]), RandomPlayer()))
    with a_run(tmp_path, range(3)) as run:
        assert [which.episode for which in run.todo] == [1, 2]
        for which in list(run.todo):
            run.save(play(run.make(which), RandomPlayer()))
        ((task, successes, episodes, paper),) = run.summary()
    records = read_records(tmp_path / "episodes.jsonl")
    assert [record.episode for record in records] == [0, 1, 2]
    assert (task, successes, episodes) == ("VideoUnmask", sum(r.success for r in records), 3)
    assert (paper["Human"], paper["Gemini-2.5-Pro"]) == (90, 86)


def test_own_tasks_are_summed_up_beside_the_benchmarks(tmp_path, capsys):
    with a_run(tmp_path) as run:
        for which in (an_episode(0), replace(an_episode(1), task="TwoButtons")):
            run.save_error(which, "it fell over")
        assert [(task, count, bool(paper)) for task, _, count, paper in run.summary()] == [
            ("VideoUnmask", 1, True),
            ("TwoButtons", 1, False),
        ]
        print_summary(run)
    assert "TwoButtons" in capsys.readouterr().out


def test_an_error_is_played_again_only_when_requested(tmp_path):
    with a_run(tmp_path, [0]) as run:
        session = run.make(run.todo[0])
        session.start()
        session.choose({"choice": "c"})
        assert run.save(session).outcome == "error"
    with a_run(tmp_path, [0]) as run:
        assert run.todo == []
        identity = run.identity
    with PlayRun(
        tmp_path, [an_episode()], identity, lambda _: a_session(), retry_errors=True
    ) as run:
        assert run.todo == [an_episode()]


class Collapsing(BlocksEnv):
    """Breaks in one of its methods."""

    def __init__(self, place):
        super().__init__()
        self.place = place

    def _break(self, place):
        if place == self.place:
            raise RuntimeError(f"the scene fell apart in {place}")

    def reset(self):
        self._break("reset")
        return super().reset()

    def step(self, action):
        self._break("step")
        return super().step(action)

    def close(self):
        self._break("close")
        super().close()


def breaking_run(folder, places):
    def make(which):
        place = places[which.episode]
        if place == "make":
            raise RuntimeError("no scene for this seed")
        return ChoiceSession(Collapsing(place), which)

    return PlayRun(
        folder,
        [an_episode(n) for n in range(len(places))],
        Identity("random", 0, 0, 1300, {}),
        make,
    )


def test_an_episode_that_breaks_is_recorded_as_an_error_and_the_others_are_played(tmp_path):
    places = ["make", "", "reset", "step", "close", ""]
    with breaking_run(tmp_path, places) as run:
        _by_itself(run, RandomPlayer())
        assert run.todo == []
    records = read_records(tmp_path / "episodes.jsonl")
    assert [(r.episode, r.outcome == "error" and r.error != "no path") for r in records] == [
        (n, place in ("make", "reset", "step")) for n, place in enumerate(places)
    ]
    assert records[0].error == "RuntimeError: no scene for this seed"
    assert (
        records[3].error
        == records[3].extra["ended_by"]
        == "RuntimeError: the scene fell apart in step"
    )
    assert (records[0].seed, records[0].extra["decisions"]) == (560000, [])
    assert "no scene for this seed" in line(records[0])
    with breaking_run(tmp_path, places) as run:  # the same command again does not stumble over them
        assert run.todo == []


def test_a_mistake_of_the_user_ends_the_run(tmp_path):
    def make(which):
        raise UserError("No Vulkan driver here.")

    with PlayRun(tmp_path, [an_episode()], Identity("random", 0, 0, 1300, {}), make) as run:
        with pytest.raises(UserError, match="Vulkan"):
            _by_itself(run, RandomPlayer())
        assert run.todo == [an_episode()]
