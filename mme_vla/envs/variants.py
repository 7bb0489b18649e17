"""Splits that are the test split's scenes turned a little: harder by a dial, or with what is to be remembered in view.

`stress:count=2` is every test episode with two repetitions more, `stress:count=0` the test episodes themselves,
`stress:sessions=2` these after two unrelated episodes in the same memory; `twin`
is every test episode with the needed fact in view, so that failures of memory and of control can be told apart.
Importing this needs no simulator.
"""

import re
from dataclasses import dataclass
from typing import Any

from mme_vla.envs.task_names import TASK_NAMES
from mme_vla.errors import UserError, did_you_mean

BASE = "test"
TWIN, STRESS = "twin", "stress"
DIALS: dict[str, tuple[str, ...]] = {
    "count": ("PickXtimes", "SwingXtimes", "StopCube", "VideoRepick"),
    "containers": ("VideoUnmask", "ButtonUnmask"),
    "swaps": ("VideoUnmaskSwap", "ButtonUnmaskSwap"),
    "delay": ("VideoUnmask", "VideoUnmaskSwap", "VideoPlaceButton", "VideoPlaceOrder", "VideoRepick", "MoveCube"),
    "path": ("PatternLock",),
    "distractors": ("PickHighlight",),
}
"""Dial → the tasks that have it.

count: repetitions or visits more. containers: more, over nothing. swaps: more of them. delay: steps more between
what is shown and the execution. path: discs more on the way. distractors: more objects that are not asked for.
"""
SESSIONS = "sessions"
"""The dial that turns no scene: so many unrelated episodes come before one's own, in the same memory. All tasks have
it; an evaluation shows them."""
_STRESS = re.compile(rf"{STRESS}:([a-z_]+)=(\d{{1,4}})")


@dataclass(frozen=True)
class Variant:
    """How the scenes of a split differ from the test split's. dial, turned: of a stress split."""

    twin: bool = False
    dial: str = ""
    turned: int = 0

    @property
    def options(self) -> dict[str, Any]:
        """What a task is built with."""
        if self.twin:
            return {"in_view": True}
        return {"stress": {self.dial: self.turned}} if self.turned and self.dial != SESSIONS else {}

    @property
    def sessions(self) -> int:
        """Unrelated episodes that come before each."""
        return self.turned if self.dial == SESSIONS else 0

    def check(self, task: str) -> None:
        """Make sure that a task of the benchmark can be varied so.

        Raises:
            UserError: it is another task, or has not this dial.
        """
        if task not in TASK_NAMES:
            raise UserError(f"split={TWIN} and split={STRESS}:… vary the benchmark's tasks alone, and {task} is none.")
        if self.dial and self.dial != SESSIONS and task not in DIALS[self.dial]:
            own = [dial for dial, tasks in DIALS.items() if task in tasks]
            raise UserError(
                f"{task} has no dial {self.dial!r}; it has {', '.join(own) or 'none'}. {self.dial} is for "
                f"{', '.join(DIALS[self.dial])}."
            )


def read_variant(split: str) -> Variant | None:
    """What a split varies; None for one that varies nothing, or is none.

    Raises:
        UserError: a stress split without a dial and how far it is turned, or with an unknown one.
    """
    if split == TWIN:
        return Variant(twin=True)
    if not str(split).startswith(STRESS):
        return None
    found, known = _STRESS.fullmatch(split), (*DIALS, SESSIONS)
    if found is None:
        raise UserError(
            f"split={split!r}: say which dial is turned how far, as {STRESS}:count=2; the dials are {', '.join(known)}."
        )
    if found[1] not in known:
        raise UserError(f"split={split!r}: there is no dial {found[1]!r}. {did_you_mean(found[1], known)}")
    return Variant(dial=found[1], turned=int(found[2]))
