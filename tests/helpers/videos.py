"""Videos in memory."""

from collections.abc import Iterable
from io import BytesIO
from typing import Any

import numpy as np

from mme_vla.utils.media import VideoWriter


def video_bytes(frames: Iterable[np.ndarray], **options: Any) -> bytes:
    """The file that `write_video` would write."""
    buffer = BytesIO()
    with VideoWriter(buffer, **options) as video:
        for frame in frames:
            video.add(frame)
    return buffer.getvalue()
