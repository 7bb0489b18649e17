"""Which frames a recurrent memory reads: a stride back from the current frame, and a thinner pass over the video."""

import numpy as np


def recurrent_frames(
    step: int, exec_start: int, max_steps: int = 64, max_video: int = 40, stride: int = 16
) -> np.ndarray:
    """Frames read at `step`, ascending and ending with `step`; at most `max_steps`, the earliest dropped first.

    Execution frames stand `stride` apart, counted back from `step`, so the offset comes from `step` alone. Video
    frames stand half a stride apart in a video of up to two strides, a stride apart while that gives no more than
    `max_video`, and are spread evenly, both ends included, beyond that.

    Args:
        step: the current frame. exec_start: the first execution frame (0 without video). While the video still runs,
            all frames before the current one count as video, so a finished episode and a running one agree.

    Returns:
        int64 [n].
    """
    start = min(exec_start, step)
    execution = np.arange(start + (step - start) % stride, step + 1, stride)
    return np.concatenate([video_frames(start, max_video, stride), execution])[-max_steps:]


def video_frames(length: int, max_video: int, stride: int) -> np.ndarray:
    """Frames read of a conditioning video of `length` frames."""
    if length <= 2 * stride:
        return np.arange(0, length, max(stride // 2, 1))
    if length <= max_video * stride:
        return np.arange(0, length, stride)
    return np.linspace(0, length - 1, max_video).astype(np.int64)


def jittered(frames: np.ndarray, exec_start: int, jitter: int, rng: np.random.Generator) -> np.ndarray:
    """Move every frame but the last by up to `jitter` frames, video and execution each within its own part."""
    past, step = frames[:-1], frames[-1]
    moved = past + rng.integers(-jitter, jitter + 1, len(past))
    video = past < exec_start
    low, high = np.where(video, 0, exec_start), np.where(video, min(exec_start, step) - 1, step - 1)
    return np.append(np.unique(np.clip(moved, low, high)), step)
