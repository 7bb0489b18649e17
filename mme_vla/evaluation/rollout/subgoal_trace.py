"""What a predictor said in one episode: every subgoal on disk, with its time and the picture it was used for."""

import json
import shutil
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from mme_vla.evaluation.rollout.subgoal_score import SubgoalScore
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode
from mme_vla.subgoal.oracle import online_subgoal

SUBGOALS = "subgoals"
"""Name of the folder within a run."""


class SubgoalTrace:
    """Scores the subgoals of an episode and, given a folder, writes them down as they come.

    `<folder>/<name>.jsonl` has a line for each time the policy acted, `<folder>/<name>/<step>.jpg` the picture it acted
    on. A subgoal that was kept, or came in the background, is older: `asked_step` is the step of its question.
    What an earlier try of the same episode left there is replaced.

    Args:
        kind: `simple` or `grounded`. folder: None keeps the score alone. name: of the episode.
    """

    def __init__(self, kind: str, folder: Path | None, name: str) -> None:
        self.score = SubgoalScore()
        self._kind, self._name, self._folder = kind, name, folder
        self._meant: str | None = None
        self._begun = time.perf_counter()
        if folder is not None:
            shutil.rmtree(folder / name, ignore_errors=True)
            (folder / name).mkdir(parents=True, exist_ok=True)
            self._file.write_bytes(b"")

    def add(self, episode: SubgoalEpisode, subgoal: Subgoal, latency_s: float) -> None:
        """Note the subgoal that the policy acts on now.

        Args:
            episode: as the predictor knows it, its last frame and report the current ones.
            latency_s: seconds the policy waited for it.
        """
        # Between two sub-tasks the environment names none, and the last one stays, as in training.
        self._meant = online_subgoal(episode.info, self._kind) or self._meant
        self.score.add(subgoal.text, self._meant, subgoal.asked, subgoal.problem)
        if self._folder is None:
            return
        picture = f"{self._name}/{episode.step:05d}.jpg"
        _save(episode.frame, self._folder / picture)
        line = {
            "step": episode.step,
            "seconds": round(time.perf_counter() - self._begun, 3),
            "latency_s": round(latency_s, 4),
            "when": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "text": subgoal.text,
            "points": subgoal.points,
            "oracle": self._meant,
            "asked": subgoal.asked,
            "asked_step": episode.asked_step,
            "answer": subgoal.answer,
            "problem": subgoal.problem,
            "image": picture,
        }
        with self._file.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")

    @property
    def _file(self) -> Path:
        assert self._folder is not None
        return self._folder / f"{self._name}.jsonl"


def _save(picture: np.ndarray, path: Path) -> None:
    from PIL import Image

    Image.fromarray(picture).save(path, quality=90)
