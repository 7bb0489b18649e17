"""The sixteen tasks by name; importing this needs no simulator."""

TASK_NAMES = (
    "PickXtimes", "StopCube", "SwingXtimes", "BinFill",
    "VideoUnmaskSwap", "VideoUnmask", "ButtonUnmaskSwap", "ButtonUnmask",
    "VideoRepick", "VideoPlaceButton", "VideoPlaceOrder", "PickHighlight",
    "InsertPeg", "MoveCube", "PatternLock", "RouteStick",
)  # fmt: skip
"""In the benchmark's order, which the seeds of the episodes follow."""

STICK_TASKS = ("PatternLock", "RouteStick")
"""Tasks whose robot holds a stick instead of a gripper."""
