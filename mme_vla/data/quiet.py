"""What LeRobot, datasets, tqdm and FFmpeg say of their own work stays off the terminal; warnings and errors do not."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partialmethod


@contextmanager
def quiet_libraries() -> Iterator[None]:
    """Surround work whose progress this library shows itself.

    Notes go that are no warnings; bars of tqdm are drawn on terminals alone, those of `datasets` not at all.
    """
    import av.logging
    import tqdm
    from lerobot.utils.utils import SuppressProgressBars

    root = logging.getLogger()  # LeRobot reports by it
    level, begin = root.level, tqdm.tqdm.__init__
    root.setLevel(max(level, logging.WARNING))
    tqdm.tqdm.__init__ = partialmethod(begin, disable=None)
    # x264 sums up every film that it closes. LeRobot asks for warnings only, but not until then.
    av.logging.set_libav_level(av.logging.ERROR)
    try:
        with SuppressProgressBars():
            yield
    finally:
        av.logging.set_libav_level(av.logging.INFO)  # FFmpeg's own default
        tqdm.tqdm.__init__ = begin
        root.setLevel(level)
