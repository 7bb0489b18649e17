"""`oracle`: the subgoal that the environment itself reports, an upper bound for every predictor."""

from collections.abc import Mapping, Sequence
from typing import Any

from mme_vla.errors import require
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.text import points_of


@SUBGOALS.register("oracle")
class Oracle(SubgoalPredictor):
    """Reads `<kind>_subgoal_online` from the environment's report.

    An episode that is over, or between two sub-tasks, reports none (`complete`, `no record`): the
    last one then stays, as in training.
    """

    sees_video = sees_passing = False

    def predict_due(self, episodes: Sequence[SubgoalEpisode]) -> list[Subgoal]:
        return [self._read(episode) for episode in episodes]

    def _read(self, episode: SubgoalEpisode) -> Subgoal:
        require(
            isinstance(episode.info.get(f"{self.kind}_subgoal_online"), str),
            f"subgoal=oracle needs the environment's '{self.kind}_subgoal_online' in observe(…,"
            f" info); it reports {sorted(map(str, episode.info)) or 'nothing'}.",
        )
        text = online_subgoal(episode.info, self.kind)
        if text is None:
            return Subgoal(episode.subgoal.text, episode.subgoal.points)
        return Subgoal(text, points_of(text))


def online_subgoal(info: Mapping[str, Any], kind: str) -> str | None:
    """The subgoal that an environment reports, lower-case as in training; None where
    it names none.
    """
    text = info.get(f"{kind}_subgoal_online")
    text = text.strip().lower() if isinstance(text, str) else ""
    return None if text in ("", "complete", "no record") else text
