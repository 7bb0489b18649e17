"""`oracle`: the subgoal that the environment itself reports, an upper bound for every predictor."""

from collections.abc import Mapping, Sequence
from typing import Any

from mme_vla.errors import UserError
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
        subgoals = []
        for episode in episodes:
            key = f"{self.kind}_subgoal_online"
            if not isinstance(episode.info.get(key), str):
                raise UserError(
                    f"subgoal=oracle needs the environment's {key!r} in observe(…, info); it"
                    f" reports {sorted(map(str, episode.info)) or 'nothing'}."
                )
            text = online_subgoal(episode.info, self.kind)
            if text is None:
                last = episode.subgoal
                subgoals.append(Subgoal(last.text, last.points))
            else:
                subgoals.append(Subgoal(text, points_of(text)))
        return subgoals


def online_subgoal(info: Mapping[str, Any], kind: str) -> str | None:
    """Return the subgoal that an environment reports, lower-case as in training.

    It is None where the environment names none.
    """
    text = info.get(f"{kind}_subgoal_online")
    if not isinstance(text, str):
        return None
    text = text.strip().lower()
    if text in ("", "complete", "no record"):
        return None
    return text
