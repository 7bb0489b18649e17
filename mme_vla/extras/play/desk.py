"""What the page shows and does, without the web: one episode after the other, simulated in a thread
of its own.
"""

import io
import logging
import struct
import time
import uuid
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from mme_vla.errors import UserError, counted, require
from mme_vla.extras.play.game import ChoiceSession
from mme_vla.extras.play.run import PlayRun

log = logging.getLogger("mme_vla.play")
QUALITY = 92  # of the JPEG frames
REACH = 24.0
"""Pixels between a point and the object that it means, at most. In five tasks that were measured no
object had a pixel more than 19 away from its place. A policy's point takes the nearest object from
anywhere.
"""


class StaleError(Exception):
    """A choice for a question that is no longer asked."""


class Desk:
    """Leads one person through the episodes of a run.

    Everything that touches the simulator runs in one thread, which also made it. The other methods
    return at once.

    run: whose episodes are played.
    participant: kept with each record.

    Attributes:
        phase: `loading` (an episode is being set up), `choosing`, `moving`, `ended` (of one
            episode), `finished` (of all), or `broken` (see `error`; `proceed` tries again).
        address: where the page is served, for the log.
    """

    def __init__(self, run: PlayRun, participant: str) -> None:
        self.run, self.participant = run, participant
        self.phase, self.error = "loading", ""
        self.address = ""
        self.session: ChoiceSession | None = None
        self.session_id = ""
        self._objects: dict[str, list[tuple[float, float]]] = {}  # see `ChoiceSession.objects`
        self._since = time.monotonic()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="simulator")

    # What the person does -------------------------------------------------------------------------

    def begin(self) -> None:
        """Set the next episode up, or say that there is none."""
        if self.run.todo:
            self._enter("loading")
            self._work(self._load)
        else:
            self._enter("finished")

    def choose(self, request: Mapping[str, Any]) -> None:
        """Carry a choice out.

        request: `choice` and `point`, with `session` and `decision` (how many were made before), so
            that a choice sent twice, or from a page left open, does nothing.

        Raises:
            StaleError: the question is no longer asked.
            UserError: the choice cannot be made; nothing has happened.
        """
        session = self.session
        requested = (request.get("session"), request.get("decision"))
        if (
            self.phase != "choosing"
            or session is None
            or requested != (self.session_id, len(session.decisions))
        ):
            raise StaleError("This was decided already; the page shows the present question.")
        option, point = session.check(request)
        if point is not None and (pixels := self._objects.get(option.label)):
            nearest = min(float(np.hypot(*np.subtract(pixel, point))) for pixel in pixels)
            require(
                nearest <= REACH,
                f"There is no object at row {point[0]:g}, column {point[1]:g}: the nearest is"
                f" {nearest:.0f} pixels away, and {REACH:g} are allowed. Click an object.",
            )
        action = {"choice": request["choice"], "point": request.get("point")}
        self._enter("moving")
        self._work(lambda: self._move(session, action))

    def proceed(self) -> None:
        """Go on after the end of an episode, or try again after a breakdown; otherwise nothing
        happens.
        """
        session = self.session
        if (
            self.phase == "broken"
            and session is not None
            and session.over
            and session.episode in self.run.todo
        ):
            self._work(lambda: self._after(session))  # it was played, and could not be saved
        elif self.phase in ("ended", "broken"):
            self.begin()

    # What the page shows --------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """All but the frames, as JSON takes it."""
        # The simulator's thread changes these meanwhile: each is read once.
        run = self.run
        phase = self.phase
        session = self.session
        session_id = self.session_id
        todo = list(run.todo)
        done = len(run.episodes) - len(todo)
        state: dict[str, Any] = {
            "phase": phase,
            "error": self.error,
            "for_s": round(time.monotonic() - self._since, 1),
            "total": len(run.episodes),
            "played": done,
            "successes": sum(record.success for record in run.records),
            "participant": self.participant,
            "session": session_id,
        }
        if phase == "finished":
            state["summary"] = []
            for task, successes, count, paper in run.summary():
                human = paper.get("Human")
                state["summary"].append(
                    {"task": task, "successes": successes, "episodes": count, "human": human}
                )
        which = None
        if session is not None:
            which = session.episode
        elif todo:
            which = todo[0]
        if which is not None:
            state |= {"task": which.task, "split": which.split, "episode": which.episode}
        if session is not None and session.reveals:
            reveals, decisions = list(session.reveals), list(session.decisions)
            options = []
            for option in session.options:
                options.append({**vars(option), "objects": self._objects.get(option.label)})
            state |= {
                "goal": session.goal,
                "status": session.status,
                "steps": session.steps,
                "problem": session.error,
                "ended_by": session.ended_by,
                "max_choices": session.max_choices,
                "options": options,
                "reach": REACH,
                "reveals": [
                    {"title": r.title, "start": r.start, "count": len(r.frames)} for r in reveals
                ],
                "decisions": [
                    {"choice": d.choice, "action": d.action, "point": d.point} for d in decisions
                ],
                "video": len(reveals[0].frames) - 1,
            }
        return state

    def frames(self, session_id: str, number: int) -> bytes:
        """The frames of one reveal, as JPEGs behind a table: their number and each one's size in
        bytes, all uint32 in little-endian order.

        Raises:
            StaleError: another episode is on, or it has no such reveal.
        """
        from PIL import Image

        session = self.session
        if (
            session is None
            or session_id != self.session_id
            or not 0 <= number < len(session.reveals)
        ):
            raise StaleError("There are no such frames: another episode is on.")
        images = []
        for frame in session.reveals[number].frames:
            buffer = io.BytesIO()
            image = Image.fromarray(np.asarray(frame))
            image.save(buffer, "JPEG", quality=QUALITY, subsampling=0)
            images.append(buffer.getvalue())
        table = struct.pack(f"<{len(images) + 1}I", len(images), *map(len, images))
        return table + b"".join(images)

    def close(self) -> None:
        """Wait for a motion that is under way, and free the simulator."""
        self._thread.submit(self._free)
        self._thread.shutdown(wait=True)

    # In the simulator's thread --------------------------------------------------------------------

    def _load(self) -> None:
        self._free()
        which = self.run.todo[0]
        log.info("%s, episode %d of %s: setting up", which.task, which.episode, which.split)
        session = self.run.make(which)
        try:
            session.start()
        except BaseException:
            session.close()
            raise
        self.session, self.session_id = session, uuid.uuid4().hex
        self._after(session)
        if self.phase == "choosing":
            log.info("%s, episode %d: ready at %s", which.task, which.episode, self.address)

    def _move(self, session: ChoiceSession, action: Mapping[str, Any]) -> None:
        session.choose(action)
        self._after(session)

    def _after(self, session: ChoiceSession) -> None:
        if not session.over:
            self._objects = session.objects()
            return self._enter("choosing")
        self.run.save(session, participant=self.participant)
        which = session.episode
        log.info(
            "%s, episode %d: %s after %s",
            which.task,
            which.episode,
            session.status,
            counted(len(session.decisions), "choice"),
        )
        return self._enter("ended")

    def _free(self) -> None:
        session, self.session, self.session_id = self.session, None, ""
        if session is not None:
            session.close()

    def _work(self, task: Callable[[], None]) -> None:
        def guarded() -> None:
            try:
                task()
            except Exception as error:  # the page says so; the server lives on
                log.error("%s", error, exc_info=not isinstance(error, UserError))
                self.error = str(error) or type(error).__name__
                self._enter("broken", self.error)

        self._thread.submit(guarded)

    def _enter(self, phase: str, error: str = "") -> None:
        self.error, self._since = error, time.monotonic()
        self.phase = phase  # last: who sees the phase sees what belongs to it
