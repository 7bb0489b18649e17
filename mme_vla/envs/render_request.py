"""Which images are taken: a control step costs milliseconds, an image of it some fifty."""

from collections.abc import Container, Mapping
from dataclasses import dataclass, field

from mme_vla.embodiment.robomme import CAMERAS

NOTHING: Container[int] = frozenset()


@dataclass(frozen=True)
class RenderRequest:
    """What of an episode is drawn; all else is simulated without a look.

    frames: camera (`front`, `wrist`) → numbers of the frames it shows, counted from the reset on, those of the
        conditioning video first. A `range` may reach beyond the episode's end.
    now: the cameras that show, whatever its number, the newest frame of each call of `reset` and `step`.
    grounded: whether texts with pixels are wanted, for which the front camera looks where a sub-task begins.
    """

    frames: Mapping[str, Container[int]] = field(default_factory=dict)
    now: tuple[str, ...] = CAMERAS
    grounded: bool = True

    def cameras(self, frame: int, newest: bool) -> tuple[str, ...]:
        """The cameras that show a frame of this number."""
        known = dict.fromkeys((*CAMERAS, *self.frames, *self.now))  # some environments have more than the benchmark
        return tuple(c for c in known if frame in self.frames.get(c, NOTHING) or (newest and c in self.now))
