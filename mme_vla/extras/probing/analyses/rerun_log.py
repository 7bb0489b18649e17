"""Episodes for the Rerun viewer: images, numbers and texts over the steps, in one `.rrd` file."""

from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from PIL import Image

from mme_vla.data.episodes import EpisodeSource
from mme_vla.errors import missing_extra, require

_JPEG_QUALITY = 90


class RerunLog:
    """Writes an `.rrd` file; a context manager. Look at it with `rerun <file>`.

    Everything of episode n stands below `episode_<n>/`, on the timeline `step`.
    """

    def __init__(self, path: Path) -> None:
        """Begin a file, replacing one of that name."""
        try:
            import rerun
        except ImportError:
            raise missing_extra("Rerun output", "viz") from None
        require(path.suffix == ".rrd", f"--rerun {path}: the viewer reads files that end in .rrd.")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._rerun: Any = rerun
        self._stream: Any = rerun.RecordingStream("mme_vla")
        self._stream.save(str(path))
        self._episode = 0

    def log_image(self, name: str, pixels: np.ndarray | Image.Image) -> None:
        """Log an image [H, W, 3] uint8."""
        image = self._rerun.Image(np.asarray(pixels))
        self._log(name, image.compress(jpeg_quality=_JPEG_QUALITY))

    def number(self, name: str, value: float) -> None:
        """Log a number; those below one parent (`attention/memory`, `attention/language`) share a
        plot.
        """
        self._log(name, self._rerun.Scalars(float(value)))

    def words(self, name: str, text: str) -> None:
        """Log a text."""
        self._log(name, self._rerun.TextDocument(text))

    def views(self, source: EpisodeSource, episode: int, step: int) -> None:
        """Go to a step of a recorded episode, and log its images and texts."""
        self._episode = episode
        self._stream.set_time("step", sequence=step)
        for view in source.robot.camera_names:
            self.log_image(f"views/{view}", source.frames(episode, np.array([step]), view)[0])
        self.words("goal", source.goal(episode, step))
        for kind, text in source.subgoals(episode, step).items():
            self.words(kind, text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._stream.flush()
        self._stream.disconnect()

    def _log(self, name: str, what: Any) -> None:
        self._stream.log(f"episode_{self._episode}/{name}", what)
