"""`oracle`: the subgoal that the environment itself reports, an upper bound for every predictor."""

from collections.abc import Sequence

from mme_vla.errors import UserError
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode, SubgoalPredictor
from mme_vla.subgoal.parsing import points_of


@SUBGOALS.register("oracle")
class Oracle(SubgoalPredictor):
    """Reads `<kind>_subgoal_online` from the environment's report.

    An episode that is over, or between two sub-tasks, reports none (`complete`, `no record`): the last one then
    stays, as in training.
    """

    def answer(self, episodes: Sequence[SubgoalEpisode]) -> list[Subgoal]:
        """Look the texts up.

        Raises:
            UserError: the environment reports none.
        """
        return [self._read(episode) for episode in episodes]

    def _read(self, episode: SubgoalEpisode) -> Subgoal:
        name = f"{self.kind}_subgoal_online"
        text = episode.info.get(name)
        if not isinstance(text, str):
            raise UserError(
                f"subgoal=oracle needs the environment's {name!r} in observe(…, info); it reports "
                f"{sorted(map(str, episode.info)) or 'nothing'}."
            )
        text = text.strip().lower()
        if text in ("", "complete", "no record"):
            return Subgoal(episode.subgoal.text, episode.subgoal.points)
        return Subgoal(text, points_of(text))
