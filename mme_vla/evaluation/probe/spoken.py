"""Interventions on what a policy is told: symbolic memories, probed as the neural ones are."""

import re
from dataclasses import dataclass
from typing import ClassVar

from mme_vla.evaluation.probe.interventions import Intervention, Moment, whole
from mme_vla.registry import INTERVENTIONS

_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
_NUMBERS = ("one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
_COUNT = re.compile(rf"<[^>]*>|\b(?:{'|'.join((*_ORDINALS, *_NUMBERS))}|\d+)\b")  # points are read, and left alone


@INTERVENTIONS.register("subgoal_swap")
@dataclass(frozen=True)
class SubgoalSwap(Intervention):
    """The subgoal of another recorded episode that is as far along."""

    needs: ClassVar = frozenset({"subgoal", "recordings"})

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return subgoal if moment.donor_said is None else moment.donor_said


@INTERVENTIONS.register("subgoal_delay")
@dataclass(frozen=True)
class SubgoalDelay(Intervention):
    """The subgoal that was said `decisions` chunks ago; the first one until then."""

    decisions: int = 2
    dial: ClassVar = "decisions"
    needs: ClassVar = frozenset({"subgoal"})

    def __post_init__(self) -> None:
        whole("subgoal_delay.decisions", self.decisions, 1)

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return moment.said[max(len(moment.said) - 1 - self.decisions, 0)] if moment.said else subgoal


@INTERVENTIONS.register("subgoal_count")
@dataclass(frozen=True)
class SubgoalCount(Intervention):
    """Every count in the subgoal is wrong by `by`: `for the first time` becomes `for the second time`."""

    by: int = 1
    dial: ClassVar = "by"
    needs: ClassVar = frozenset({"subgoal"})

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        return None if subgoal is None else _COUNT.sub(self._wrong, subgoal)

    def _wrong(self, found: re.Match[str]) -> str:
        word = found[0]
        for words in (_ORDINALS, _NUMBERS):
            if word in words:
                return words[(words.index(word) + self.by) % len(words)]
        return str(max(int(word) + self.by, 0)) if word.isdigit() else word
