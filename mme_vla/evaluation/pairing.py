"""Which episodes of several runs are of the same scenes, and may be paired: every comparison asks
here.
"""

from collections import Counter
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass

from mme_vla.envs.scene_hash import NOT_BUILT
from mme_vla.errors import counted
from mme_vla.evaluation.records import EpisodeRecord


@dataclass(frozen=True)
class Pairing[Key: Hashable]:
    """What may be paired, and what was left out.

    keys: of the episodes whose scenes are the same in all runs, in the order of the first run.
    unnamed: of these, how many have no digest in any run, so that task, number and seed alone say
        that they are the same.
    other: task → how many were left out because their scenes differ, or only some runs name them.
    """

    keys: tuple[Key, ...]
    unnamed: int
    other: Mapping[str, int]

    @property
    def left_out(self) -> int:
        """How many episodes are common by task and number, and are not paired."""
        return sum(self.other.values())

    def notes(self, what: str) -> list[str]:
        """What a reader has to know, one sentence each. what: which runs are compared."""
        lines = self.gaps(what)
        if self.unnamed:
            lines.append(
                f"{what}: {self.unnamed} of {len(self.keys)} paired episodes have no digest of"
                " their scene on either side: they are taken for the same by task, number and"
                " seed."
            )
        return lines

    def gaps(self, what: str) -> list[str]:
        """The notes on episodes that are not paired: all that matters where one command ran both
        sides.
        """
        if not self.other:
            return []
        tasks = ", ".join(f"{task} {count}" for task, count in self.other.items())
        return [
            f"{what}: {counted(self.left_out, 'episode')} not paired ({tasks}), for the scenes are"
            " different ones in these runs, or only some of the runs name the scene: they were"
            " built by other versions or on other machines. Evaluate them with one version."
        ]


def pair[Key: Hashable](sides: Sequence[Mapping[Key, Collection[EpisodeRecord]]]) -> Pairing[Key]:
    """Pair the episodes that all sides have and whose scenes are the same in all their records.

    Scenes are the same where all records have equal digests, or where none has one; and where their
    seeds are equal. An episode that ended before its scene was built goes with any scene of its
    seed.

    Args:
        sides: of each run, its records by what makes an episode the same, such as task and number.
    """
    keys: list[Key] = []
    unnamed = 0
    other: Counter[str] = Counter()
    for key in sides[0]:
        if not all(key in side for side in sides):
            continue
        records: list[EpisodeRecord] = []
        for side in sides:
            records += side[key]
        scenes = {record.named_scene for record in records if record.scene != NOT_BUILT}
        seeds = {record.seed for record in records}
        if len(scenes) > 1 or len(seeds) > 1:
            other[records[0].task] += 1
        else:
            keys.append(key)
            if scenes <= {None}:
                unnamed += 1
    return Pairing(tuple(keys), unnamed, dict(other))
