"""A history transform of one's own: the robot hesitates, so that frames of the execution are
observed again.
"""

from dataclasses import dataclass

import numpy as np

from mme_vla import Perturbation, register


@register("perturbation", "hesitate")
@dataclass(frozen=True)
class Hesitate(Perturbation):
    """Each frame of the execution is repeated `times` times with probability `p`; in a probe every
    1/p-th frame.
    """

    times: int = 4
    p: float = 0.1
    dial = "times"

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        frames = np.arange(length)
        often = np.floor((frames + 1) * self.p) > np.floor(frames * self.p)
        again = often if rng is None else rng.random(length) < self.p
        return 1 + self.times * (again & (frames >= exec_start))
