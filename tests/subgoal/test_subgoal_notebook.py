"""A model with a notebook: what its notes may be, and that they change only when a subgoal was seen
complete.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from helpers.chat_server import ChatServer, Reply, chat_server, failure, says
from helpers.subgoal_fakes import frames
from mme_vla.errors import UserError
from mme_vla.subgoal import NotebookPredictor, build_predictor
from mme_vla.subgoal.notebook import MONITOR, Count, Identity, Notebook, Route, read_notes
from mme_vla.subgoal.text import MalformedReply

QUICK = {"retries": 0}
COUNT = {"kind": "count", "name": "placed", "value": 0}


# Notes --------------------------------------------------------------------------------------------


def test_notes_of_every_kind_are_read_and_reported_in_words() -> None:
    notes = [
        COUNT,
        {"kind": "identity", "name": "red cube's container", "words": "the left\n one"},
        {"kind": "route", "name": "pattern", "steps": ["left", "forward"], "done": 1},
    ]
    book = Notebook().with_entries(read_notes(notes), None)
    assert book.notes == {
        "placed": Count(0),
        "red cube's container": Identity("the left one"),
        "pattern": Route(("left", "forward"), 1),
    }
    assert book.in_words() == (
        "- count, placed: 0\n- identity, red cube's container: the left one\n"
        "- route, pattern: 1. left; 2. forward (1 of 2 done)"
    )
    assert Notebook().in_words() == "- nothing yet"


@pytest.mark.parametrize(
    "given",
    [
        "notes",
        [1],
        [{"kind": "count", "name": "a"}],
        [{"kind": "count", "name": "a", "value": -1}],
        [{"kind": "count", "name": "a", "value": True}],
        [{"kind": "count", "value": 1}],
        [{"kind": "count", "name": " ", "value": 1}],
        [{"kind": "route", "name": "a", "steps": []}],
        [{"kind": "route", "name": "a", "steps": ["x", 3]}],
        [{"kind": "identity", "name": "a", "words": "x" * 201}],
        [{"kind": "thought", "name": "a"}],
        [{"kind": "identity", "name": "a", "words": "half \ud800"}],
    ],
)
def test_what_is_no_note_is_refused(given: Any) -> None:
    with pytest.raises(MalformedReply):
        read_notes(given)


@pytest.mark.parametrize(
    ("before", "after", "finished", "allowed"),
    [
        (Count(1), Count(2), True, True),
        (Count(1), Count(1), True, True),
        (Count(1), Count(3), True, False),
        (Count(1), Count(0), True, False),
        (Count(1), Count(2), False, False),
        (Route(("a", "b"), 0), Route(("a", "b"), 1), True, True),
        (Route(("a", "b"), 0), Route(("a", "b"), 2), True, False),
        (Route(("a", "b"), 1), Route(("a", "b"), 0), True, False),
        (Route(("a", "b"), 0), Route(("b", "a"), 0), True, False),
        (Identity("left"), Identity("right"), True, True),
        (Identity("left"), Count(1), True, False),
    ],
)
def test_notes_change_only_as_their_kind_does(
    before: Any, after: Any, finished: bool, allowed: bool
) -> None:
    book = Notebook({"it": before})
    if allowed:
        assert book.with_entries([("it", after)], "pick" if finished else None).notes == {
            "it": after
        }
    else:
        with pytest.raises(MalformedReply):
            book.with_entries([("it", after)], "pick" if finished else None)


def test_a_route_is_no_longer_than_its_steps_and_a_notebook_has_an_end() -> None:
    with pytest.raises(MalformedReply, match="2 of 1 steps"):
        Notebook().with_entries([("way", Route(("a",), 2))], None)
    with pytest.raises(MalformedReply, match="takes 16"):
        Notebook().with_entries([(str(i), Count(0)) for i in range(17)], None)


# The predictor ------------------------------------------------------------------------------------


class Model:
    """Sees a subgoal complete where the newest image is bright, and counts; keeps what it was
    asked.
    """

    def __init__(self, server: ChatServer) -> None:
        self.queries: list[str] = []
        self.done = False
        self.value = 0
        server.respond = self.respond

    def respond(self, request: dict[str, Any]) -> Reply:
        system, message = request["messages"]
        monitor = system["content"] == MONITOR
        self.queries.append("monitor" if monitor else "planner")
        self.message = message["content"][-1]["text"]
        if monitor:
            return says(json.dumps({"why": "", "done": self.done}))
        note = {**COUNT, "value": self.value}
        return says(
            json.dumps(
                {"notes": [note], "subgoal": f"pick up the red cube at <{100 + self.value}, 500>"}
            )
        )


@pytest.fixture
def server() -> Iterator[ChatServer]:
    pytest.importorskip("openai", reason="needs the extra openai")
    with chat_server() as match:
        yield match


def predictor_for(server: ChatServer | None, **options: Any) -> NotebookPredictor:
    where = {} if server is None else {"base_url": server.url}
    options_ = {"name": "notebook", "key_variable": None, **where, **QUICK, **options}
    built = build_predictor(options_)
    assert isinstance(built, NotebookPredictor)
    return built


def test_nothing_is_noted_and_no_subgoal_returned_before_the_monitor_confirms(
    server: ChatServer,
) -> None:
    model, predictor = Model(server), predictor_for(server, kind="grounded")
    episode = predictor.start_episode("Pick it up twice", frames(20), "PickXtimes")
    episode.observe(frames(1))
    first = predictor.predict([episode])[0]
    assert first.text == "pick up the red cube at <25, 128>" and model.queries == ["planner"]
    assert episode.notebook.notes == {"placed": Count(0)} and episode.notebook.finished == ()
    model.value = 7  # which would be refused, if it were asked for
    for _ in range(3):
        episode.observe(frames(16))
        assert predictor.predict([episode])[0].text == first.text
    assert model.queries[1:] == ["monitor"] * 3 and episode.notebook.notes == {"placed": Count(0)}
    model.done, model.value = True, 1
    episode.observe(frames(16))
    assert predictor.predict([episode])[0].text == "pick up the red cube at <25, 128>"
    assert model.queries[4:] == ["monitor", "planner"]
    assert episode.notebook.notes == {"placed": Count(1)} and episode.notebook.finished == (
        first.text,
    )
    assert (
        "- count, placed: 0" in model.message
        and f"The subgoal {first.text!r} is complete" in model.message
    )
    assert predictor.usage.problems == {}


def test_a_note_that_cannot_be_leaves_notebook_and_subgoal_and_is_requested_again(
    server: ChatServer,
) -> None:
    model, predictor = Model(server), predictor_for(server)
    episode = predictor.start_episode("go", None, "PickXtimes")
    episode.observe(frames(1))
    first = predictor.predict([episode])[0]
    model.done, model.value = True, 5
    episode.observe(frames(16))
    subgoal = predictor.predict([episode])[0]
    assert (subgoal.text, subgoal.problem) == (
        first.text,
        "malformed",
    ) and episode.notebook.notes == {"placed": Count(0)}
    model.value = 1
    episode.observe(frames(16))
    assert predictor.predict([episode])[0].problem == "" and episode.notebook.notes == {
        "placed": Count(1)
    }
    assert model.queries == ["planner", "monitor", "planner", "planner"], (
        "the monitor had agreed already"
    )


def test_whatever_goes_wrong_keeps_the_subgoal_and_is_counted(server: ChatServer) -> None:
    model, predictor = Model(server), predictor_for(server)
    episode = predictor.start_episode("go")
    episode.observe(frames(1))
    first = predictor.predict([episode])[0].text
    for reply in (
        says("perhaps"),
        says('{"done": "yes"}'),
        says(None),
        failure(503, "busy"),
        says("", "content_filter"),
    ):
        server.respond = lambda request, reply=reply: reply
        episode.observe(frames(16))
        assert predictor.predict([episode])[0].text == first
    assert predictor.usage.problems == {"malformed": 2, "empty": 1, "failed": 1, "refused": 1}
    server.respond, model.done, model.value = model.respond, True, 1
    episode.observe(frames(16))
    assert predictor.predict([episode])[0].problem == "" and len(episode.since) == 0


def test_a_full_episode_is_replayed_from_its_cache_without_key_and_server(tmp_path: Path) -> None:
    pytest.importorskip("openai", reason="needs the extra openai")

    def episode_run(
        server: ChatServer | None, model: Model | None = None
    ) -> tuple[list[Any], NotebookPredictor, Notebook]:
        key = {} if server is not None else {"key_variable": "A_KEY_THAT_IS_NOT_SET"}
        predictor = predictor_for(server, cache=str(tmp_path), **key)
        episodes = [
            predictor.start_episode("go", frames(9), "BinFill"),
            predictor.start_episode("run", None),
        ]
        subgoals = []
        for step in range(4):
            if model is not None:
                model.done, model.value = step in (2, 3), max(step - 1, 0)
            for i, episode in enumerate(episodes):
                episode.observe(frames(1 if step == 0 else 16, first=50 * i + 16 * step))
            subgoals += [subgoal.text for subgoal in predictor.predict(episodes)]
        return subgoals, predictor, episodes[0].notebook

    with chat_server() as server:
        subgoals, first, notes = episode_run(server, Model(server))
    again, second, same = episode_run(None)
    assert again == subgoals and same == notes and notes.notes == {"placed": Count(2)}
    assert (first.usage.calls, second.usage.calls, second.usage.cached) == (12, 0, 12)


def test_impossible_options_are_refused() -> None:
    with pytest.raises(UserError, match=r"subgoal.api='opnai'.*'openai'"):
        NotebookPredictor(api="opnai")
    with pytest.raises(UserError, match="workers=0"):
        NotebookPredictor(workers=0)
    with pytest.raises(UserError, match="base_url"):
        NotebookPredictor(api="gemini", base_url="127.0.0.1/v1")
