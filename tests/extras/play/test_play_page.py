"""The page: its routes over HTTP, and a whole episode in a real headless browser."""

import http.client
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

import pytest

from helpers.browser import Browser
from helpers.play_fakes import (
    BLOCKS,
    MOTION,
    VIDEO,
    BlocksEnv,
    SessionWithObjects,
    a_session,
    an_episode,
)
from mme_vla.errors import UserError
from mme_vla.evaluation.store import read_records
from mme_vla.extras.play import web
from mme_vla.extras.play.desk import Desk
from mme_vla.extras.play.run import Identity, PlayRun
from mme_vla.extras.play.web import is_local, listen, make_server

pytest.importorskip(
    "starlette", reason="the page needs the extra play: uv sync --inexact --extra play"
)
pytest.importorskip(
    "uvicorn", reason="the page needs the extra play: uv sync --inexact --extra play"
)


class Served:
    """A running page."""

    def __init__(self, run, desk, port):
        self.run, self.desk, self.port = run, desk, port

    def ask(self, method, path, body=None, **headers):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        content = body if body is None or isinstance(body, bytes | str) else json.dumps(body)
        if body is not None:
            headers = {"Content-Type": "application/json", **headers}
        connection.request(method, path, content, headers)
        response = connection.getresponse()
        read = response.read()
        connection.close()
        return response, read

    def state(self):
        return json.loads(self.ask("GET", "/state")[1])

    def until(self, phase):
        end = time.monotonic() + 30
        while self.state()["phase"] != phase:
            assert time.monotonic() < end, self.state()
            time.sleep(0.02)
        return self.state()


@contextmanager
def served(folder, make=lambda which: a_session(which.episode), episodes=2, **options):
    identity = Identity("human", "anna", 0, 1300, {"player": "human"})
    with (
        PlayRun(folder, [an_episode(n) for n in range(episodes)], identity, make) as run,
        listen("127.0.0.1", 0) as at,
    ):
        desk = Desk(run, "anna")
        desk.address = f"http://127.0.0.1:{at.getsockname()[1]}"
        server = make_server(desk, **options)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [at]})
        thread.start()
        try:
            yield Served(run, desk, at.getsockname()[1])
        finally:
            server.should_exit = True
            thread.join(30)


def with_objects(which):
    return SessionWithObjects(BlocksEnv(), which)


# Over HTTP ----------------------------------------------------------------------------------------


def test_an_episode_is_played_over_http_and_recorded(tmp_path, caplog):
    caplog.set_level("INFO", "mme_vla.play")
    with served(tmp_path, episodes=1) as page:
        state = page.until("choosing")
        page.desk._thread.submit(lambda: None).result()
        assert (
            caplog.messages[-1] == f"VideoUnmask, episode 0: ready at http://127.0.0.1:{page.port}"
        )
        assert [o["label"] for o in state["options"]] == ["a", "b", "c"]
        for name in ("blue", "red"):
            state = page.until("choosing")
            choice = {
                "session": state["session"],
                "decision": len(state["decisions"]),
                "choice": "a",
            }
            response, _ = page.ask("POST", "/choose", {**choice, "point": BLOCKS[name]})
            assert response.status == 200
            page.desk._thread.submit(lambda: None).result()
        state = page.until("ended")
        assert (state["status"], state["played"], state["successes"]) == ("success", 1, 1)
        assert [(r["start"], r["count"]) for r in state["reveals"]] == [
            (0, 9),
            (9, MOTION),
            (14, MOTION),
        ]
        page.ask("POST", "/next", {})
        state = page.until("finished")
        assert state["summary"] == [
            {"task": "VideoUnmask", "successes": 1, "episodes": 1, "human": 90.0}
        ]
    (record,) = read_records(tmp_path / "episodes.jsonl")
    assert (record.model, record.checkpoint, record.outcome) == ("human", "anna", "success")
    assert [d["point"] for d in record.extra["decisions"]] == [
        list(BLOCKS["blue"]),
        list(BLOCKS["red"]),
    ]


def test_frames_come_as_jpegs_behind_a_table(tmp_path):
    with served(tmp_path) as page:
        state = page.until("choosing")
        response, packed = page.ask("GET", f"/frames/{state['session']}/0")
        count = struct.unpack_from("<I", packed)[0]
        sizes = struct.unpack_from(f"<{count}I", packed, 4)
        assert (response.status, count) == (200, VIDEO + 1)
        assert len(packed) == 4 * (count + 1) + sum(sizes)
        assert packed[4 * (count + 1) :].startswith(b"\xff\xd8")
        for path in (f"/frames/{state['session']}/1", "/frames/other/0"):
            assert page.ask("GET", path)[0].status == 404


def test_a_choice_that_cannot_be_made_is_answered_and_changes_nothing(tmp_path):
    with served(tmp_path) as page:
        state = page.until("choosing")
        request = {"session": state["session"], "decision": 0, "choice": "a", "point": [1, 1]}
        for body, status, reason in (
            ({**request, "point": None}, 400, "needs a point"),
            ({**request, "choice": "z"}, 400, "no option 'z'"),
            ({**request, "decision": 1}, 409, "decided already"),
            ({**request, "session": "other"}, 409, "decided already"),
            (b"{", 400, "not valid JSON"),
            (b"[]", 400, "must hold an object"),
            (b"\xff\xfe", 400, "not valid JSON"),
            (b" " * 5000, 400, "longer than 4096 bytes"),
        ):
            response, content = page.ask("POST", "/choose", body)
            assert response.status == status, content
            assert reason in json.loads(content)["error"]
        response, _ = page.ask(
            "POST", "/choose", json.dumps(request), **{"Content-Type": "text/plain"}
        )
        assert response.status == 400
        assert page.state()["decisions"] == []


def test_a_point_far_from_every_object_is_answered_and_one_near_an_object_is_kept(tmp_path):
    row, column = BLOCKS["blue"]
    with served(tmp_path, with_objects) as page:
        state = page.until("choosing")
        red, blue = [list(map(float, place)) for place in BLOCKS.values()]
        assert [option["objects"] for option in state["options"]] == [[red, blue], None, None]
        request = {"session": state["session"], "decision": 0, "choice": "a"}
        response, content = page.ask("POST", "/choose", {**request, "point": [row - 25, column]})
        assert response.status == 400
        assert "no object at row 155, column 190: the nearest is 25 pixels" in content.decode()
        assert page.state()["decisions"] == []
        response, _ = page.ask("POST", "/choose", {**request, "point": [row - 24, column]})
        assert response.status == 200
        page.desk._thread.submit(lambda: None).result()
        assert page.state()["decisions"][0]["point"] == [row - 24, column]


def test_a_policy_may_point_anywhere():
    session = with_objects(an_episode())
    session.start()
    session.choose({"choice": "a", "point": [250, 10]})
    assert len(session.decisions) == 1


def test_only_this_machine_is_answered_and_the_page_loads_nothing_foreign(tmp_path):
    with served(tmp_path) as page:
        for host in ("robots.example", "127.0.0.1.robots.example", ""):
            assert page.ask("GET", "/state", Host=host)[0].status == 421
        for host in ("localhost:1", "127.0.0.1", "[::1]:80"):
            assert page.ask("GET", "/state", Host=host)[0].status == 200
        for name in ("", "play.js", "player.js", "play.css"):
            response, content = page.ask("GET", f"/{name}")
            assert response.status == 200
            assert b"://" not in content
            assert "default-src 'none'" in response.headers["content-security-policy"]
        assert page.ask("GET", "/desk.py")[0].status == 404
    assert is_local("::1")
    assert not is_local("0.0.0.0")


def test_ctrl_c_frees_the_simulator_and_goes_on_behind_the_page(tmp_path):
    script = (
        "import logging; from pathlib import Path; from helpers.play_fakes import a_session,"
        " an_episode\nfrom mme_vla.extras.play.desk import Desk\n"
        "from mme_vla.extras.play.run import Identity, PlayRun\n"
        "from mme_vla.extras.play.web import serve\nlogging.basicConfig(level=logging.INFO,"
        " format='%(message)s')\nsession = a_session()\nwho = Identity('human', 'anna', 0, 1300,"
        f" {{}})\nrun = PlayRun(Path({str(tmp_path)!r}), [an_episode()], who, lambda _:"
        " session)\nserve(Desk(run, 'anna'), '127.0.0.1', 0)\nprint('freed', session.env.closed)"
    )
    here = Path(__file__).parents[2]
    paths = os.pathsep.join([str(here), str(here.parent), *sys.path])
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": paths},
    )  # fmt: skip
    lines = iter(process.stderr.readline, "")
    address = next(line for line in lines if "open http" in line).split()[1]
    end = time.monotonic() + 30
    while json.load(urllib.request.urlopen(f"{address}/state"))["phase"] != "choosing":
        assert time.monotonic() < end
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=30)
    assert (process.returncode, output) == (0, "freed True\n"), errors
    assert "Traceback" not in errors


def test_an_episode_that_cannot_be_set_up_is_reported_and_can_be_retried(tmp_path):
    outcomes = [UserError("No Vulkan driver here."), RuntimeError("the scene fell apart"), None]

    def make(which):
        if (outcome := outcomes.pop(0)) is not None:
            raise outcome
        return a_session(which.episode)

    with served(tmp_path, make) as page:
        for error in ("No Vulkan driver here.", "the scene fell apart"):
            assert page.until("broken")["error"] == error
            page.ask("POST", "/next", {})
            page.desk._thread.submit(lambda: None).result()
        assert page.until("choosing")["error"] == ""


def test_an_episode_that_cannot_be_saved_is_not_lost(tmp_path, monkeypatch):
    with served(tmp_path) as page:
        keep, full = page.run.save, [OSError("No space left on device")]

        def save(*args, **how):
            if full:
                raise full.pop()
            return keep(*args, **how)

        monkeypatch.setattr(page.run, "save", save)
        while page.state()["phase"] in ("loading", "choosing", "moving"):
            state = page.state()
            if state["phase"] == "choosing":
                decision = {"session": state["session"], "decision": len(state["decisions"])}
                page.ask("POST", "/choose", {"choice": "a", "point": [10, 20], **decision})
        assert "No space left" in page.until("broken")["error"] and page.state()["played"] == 0
        page.ask("POST", "/next", {})
        assert (
            page.until("ended")["played"] == 1
            and len(read_records(tmp_path / "episodes.jsonl")) == 1
        )


# In a browser -------------------------------------------------------------------------------------


def test_a_person_plays_with_mouse_and_keyboard(tmp_path):
    with served(tmp_path / "run") as page, Browser(tmp_path / "profile") as browser:
        browser.open(f"http://127.0.0.1:{page.port}/")
        browser.wait("document.querySelectorAll('.option:not(:disabled)').length === 3")
        assert browser.text("#goal") == "press the blocks in the order of the video"
        assert browser.text("#do").startswith("Do it")
        # the video has played to its end
        browser.wait("document.querySelector('#badge').innerText === 'Present'")
        assert browser.text("#hint") == "Choose the next action.", "the clip is over"

        # Scrub back into the video, and see that a point is only taken in the present image.
        browser.press("ArrowLeft", shift=True)
        browser.wait("document.querySelector('#frame').classList.contains('video')")
        assert browser.text("#hint") == "Choose the next action.", "it was watched"
        browser.click('.option[data-label="a"]')
        browser.wait("document.querySelector('#badge').innerText === 'Present'")
        assert browser.run("document.querySelector('#do').disabled")
        row, column = BLOCKS["blue"]
        browser.click("#image", ((row + 0.5) / 256, (column + 0.5) / 256))
        browser.wait(
            f"document.querySelector('#hint').innerText === 'Point: row {row}, column {column}.'"
        )
        browser.click("#do")
        browser.wait("document.querySelectorAll('#history li').length === 1")
        assert browser.text("#history").endswith(f"press the block at row {row}, column {column}")

        # The second choice with the keyboard alone: from the middle of the image to the red block.
        browser.wait("document.querySelectorAll('.option:not(:disabled)').length === 3")
        browser.press("a")
        for _ in range(6):
            browser.press("ArrowUp", shift=True)
            browser.press("ArrowLeft", shift=True)
        browser.press("ArrowUp")
        browser.press("Enter")
        browser.wait("document.querySelector('#outcome-title').innerText === 'Solved'")
        browser.press("Enter")
        browser.wait("document.querySelector('#where').innerText.includes('episode 1')")

        # The second episode goes wrong; the planner says why.
        browser.wait("document.querySelectorAll('.option:not(:disabled)').length === 3")
        browser.press("c")
        browser.press("Enter")
        browser.wait("document.querySelector('#outcome').classList.contains('error')")
        assert "no path" in browser.text("#outcome-text")
        browser.click("#next")
        browser.wait(
            "document.querySelector('#outcome-title').innerText.startsWith('All episodes')"
        )
        assert browser.problems == []
    first, second = read_records(tmp_path / "run" / "episodes.jsonl")
    assert [d["point"] for d in first.extra["decisions"]] == [[180, 190], [67, 68]]
    assert (first.outcome, second.outcome, second.error) == ("success", "error", "no path")


def test_the_page_marks_the_object_that_a_point_means(tmp_path):
    hidden = "document.querySelector('#object').hidden"
    row, column = BLOCKS["blue"]
    with (
        served(tmp_path / "run", with_objects) as page,
        Browser(tmp_path / "profile") as browser,
    ):
        browser.open(f"http://127.0.0.1:{page.port}/")
        browser.wait("document.querySelector('#badge').innerText === 'Present'")
        browser.press("a")
        browser.click("#image", (0.95, 0.05))
        browser.wait("document.querySelector('#hint').innerText.includes('no object here')")
        assert browser.run(hidden) and browser.run("document.querySelector('#do').disabled")
        browser.press("Enter")
        browser.click("#image", ((row + 10) / 256, (column - 10) / 256))
        browser.wait("document.querySelector('#hint').innerText.includes('dashed ring')")
        assert not browser.run(hidden)
        place = browser.run("parseFloat(document.querySelector('#object').style.top)")
        assert place == pytest.approx(100 * (row + 0.5) / 256, abs=0.01), "of the object"
        browser.press("Enter")
        browser.wait("document.querySelectorAll('#history li').length === 1")
        assert browser.run(hidden)
        assert browser.problems == []


def test_the_page_says_when_the_server_is_gone(tmp_path):
    with Browser(tmp_path / "profile") as browser:
        with served(tmp_path / "run") as page:
            browser.open(f"http://127.0.0.1:{page.port}/")
            browser.wait("document.querySelectorAll('.option:not(:disabled)').length === 3")
        browser.wait("document.querySelector('#error').innerText.includes('does not respond')")


def ended(connection):
    """What came until the server closed the connection."""
    connection.settimeout(30)
    received = b""
    try:
        while piece := connection.recv(2**16):
            received += piece
    except ConnectionResetError:
        pass
    return received


def test_headers_and_bodies_that_never_end_are_not_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(web, "ARRIVAL_S", 0.5)
    with served(tmp_path) as page:
        at = ("127.0.0.1", page.port)
        head = (
            b"POST /next HTTP/1.1\r\nHost: localhost\r\nContent-Type:"
            b" application/json\r\nContent-Length: 9\r\n\r\n"
        )
        with socket.create_connection(at) as silent, socket.create_connection(at) as half:
            half.sendall(b"GET /state HTTP/1.1\r\nHost:")
            assert ended(silent) == ended(half) == b""
        with socket.create_connection(at) as again:
            again.sendall(b"GET /icon.svg HTTP/1.1\r\nHost: localhost\r\n\r\nGET /state HT")
            assert ended(again).startswith(b"HTTP/1.1 200")
        with socket.create_connection(at) as slow:
            slow.sendall(head + b"{")
            reply = ended(slow)
        assert reply.startswith(b"HTTP/1.1 400") and b"did not arrive within" in reply
        assert page.ask("GET", "/state")[0].status == 200


@pytest.mark.parametrize("method", ["POST /choose", "GET /state"])
def test_a_body_that_is_not_read_ends_the_connection(tmp_path, method):
    with served(tmp_path) as page, socket.create_connection(("127.0.0.1", page.port)) as endless:
        endless.sendall(
            method.encode() + b" HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            b"Content-Length: 1000000000\r\n\r\n" + bytes(5000)
        )
        reply = ended(endless)
    assert b"connection: close" in reply.lower().partition(b"\r\n\r\n")[0]
