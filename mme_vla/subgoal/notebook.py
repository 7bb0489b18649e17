"""`notebook`: a prompted model that watches for completion, and takes typed notes only when it has seen it."""

import threading
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mme_vla.errors import UserError
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.models.api import ApiFailure, make_api
from mme_vla.subgoal.models.connection import Shown
from mme_vla.subgoal.models.threads import side_by_side
from mme_vla.subgoal.notes import Notebook, read_notes
from mme_vla.subgoal.words.notebook_prompts import MONITOR, monitor_query, next_query, opening_query, planner_system
from mme_vla.subgoal.words.parsing import MalformedAnswer, json_object, parse_gemini, pixels_of_pairs, says_done

CLIP = 4  # frames: fewer are not worth a video
LONGEST = 200  # frames of a subgoal that are shown: the last ones of a longer one


class NotebookEpisode(SubgoalEpisode):
    """An episode, its notebook, and the frames since its subgoal was given.

    agreed: the monitor has seen the current subgoal complete, and the next one is still to be named.
    """

    def __init__(self, goal: str, video: np.ndarray | None, task: str) -> None:
        super().__init__(goal, video, task)
        self.notebook = Notebook()
        self.since: list[np.ndarray] = []
        self.agreed = False

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        """Take frames, see `SubgoalEpisode`."""
        super().observe(frames, info)
        self.since = [*self.since, *frames][-LONGEST:]

    def pictures(self) -> list[Shown]:
        """The video of the current subgoal, if it is worth one, and the present picture."""
        clip = [Shown(np.stack(self.since))] if len(self.since) >= CLIP else []
        return [*clip, Shown(self.frame)]


@SUBGOALS.register("notebook")
class NotebookPredictor(SubgoalPredictor):
    """Asks whether the subgoal is complete; only then brings the notebook up to date and names the next one.

    The notebook is what a question tells of the past, beside the frames of the current subgoal: no conversation grows.
    Nothing that goes wrong ends an episode: it keeps its subgoal and its notebook, and the problem is counted.

    Args:
        interval: steps between two questions to the monitor.
        workers: questions under way at once.
        api: how the model is spoken to (`mme_vla.subgoal.models.api.CONNECTIONS`).
        client: what the questions go to; None makes one.
        settings: keys of the api's settings.
    """

    def __init__(
        self,
        kind: str = "grounded",
        interval: int = 16,
        workers: int = 4,
        api: str = "openai",
        client: Any = None,
        **settings: Any,
    ) -> None:
        super().__init__(kind, interval)
        if workers < 1:
            raise UserError(f"workers={workers} must be at least 1: questions under way at once.")
        self.workers = workers
        self.api = make_api(api, settings, "subgoal", self.usage, client)
        self._lock = threading.Lock()

    def start_episode(self, goal: str, video: np.ndarray | None = None, task: str = "") -> NotebookEpisode:
        """Begin an episode, see `SubgoalPredictor`."""
        return NotebookEpisode(goal, video, task)

    def answer(self, episodes: Sequence[NotebookEpisode]) -> list[Subgoal]:
        """Ask for all of them, some at a time."""
        return side_by_side(self._ask, episodes, self.workers)

    def _ask(self, episode: NotebookEpisode) -> Subgoal:
        said: list[str] = []
        try:
            if episode.subgoal.text is not None and not self._complete(episode, said):
                return Subgoal(episode.subgoal.text, episode.subgoal.points, asked=True, answer=said[0])
            return self._next(episode, said)
        except ApiFailure as failure:
            problem, reason = failure.problem, str(failure)
        except MalformedAnswer as error:
            problem, reason = "malformed", str(error)
        with self._lock:
            return self.kept(episode, problem, "\n".join(said), reason)

    def _complete(self, episode: NotebookEpisode, said: list[str]) -> bool:
        """Whether the monitor has seen the current subgoal complete, now or before; its answer is added to `said`."""
        if not episode.agreed:
            pictures = episode.pictures()
            query = monitor_query(episode.goal, str(episode.subgoal.text), len(pictures) > 1)
            said.append(self.api.ask(MONITOR, [("user", [*pictures, query])]).text)
            done = json_object(said[-1]).get("done")
            if not isinstance(done, bool):
                raise MalformedAnswer("the monitor's answer does not say whether it is done")
            episode.agreed = done
        return episode.agreed

    def _next(self, episode: NotebookEpisode, said: list[str]) -> Subgoal:
        """The planner's next subgoal, its notes written; its answer is added to `said`."""
        finished, parts = episode.subgoal.text, episode.pictures()
        if finished is None:
            video = [Shown(episode.video)] if len(episode.video) else []
            parts = [*video, Shown(episode.frame)]
            query = opening_query(episode.goal, bool(video))
        else:
            query = next_query(episode.goal, finished, episode.notebook.in_words(), len(parts) > 1)
        said.append(self.api.ask(planner_system(episode.task, self.kind), [("user", [*parts, query])]).text)
        text = parse_gemini(said[-1]).lower()
        notebook = episode.notebook.written(read_notes(json_object(said[-1]).get("notes", [])), finished)
        if says_done(text):
            subgoal = Subgoal(finished, episode.subgoal.points, asked=True, answer="\n".join(said))
        else:
            subgoal = self.accepted(pixels_of_pairs(text), "\n".join(said))
        episode.notebook, episode.since, episode.agreed = notebook, [], False
        return subgoal
