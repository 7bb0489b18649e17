"""What the model with a notebook is told: as a monitor that watches one subgoal, and as a planner that takes notes."""

from mme_vla.subgoal.words.gemini_prompts import example_of, what_there_is

MONITOR = (
    "You watch a robot arm at a table through a camera in front of it, and judge one thing alone: whether it has "
    "completed the subgoal that it was given. An object is picked up once it is in the air; it is put down once the "
    "gripper has let go of it; a button is pressed once it was pushed down; a place is reached once the tool is over "
    "it. What only seems to be about to happen is not complete.\n\n"
    'Answer with JSON alone: {"why": "what is to be seen", "done": true} or {"why": "…", "done": false}.'
)


def planner_system(task: str, kind: str) -> str:
    """The system prompt of the planner.

    Args:
        task: its name; for an unknown one the subgoals of all tasks are listed. kind: `simple` or `grounded`.
    """
    example = example_of(task, kind)
    parts = [
        "You lead a robot arm at a table, which you see through a camera in front of it. You keep a notebook, the only "
        "thing that you remember from one question to the next: write down what later decisions depend on. Whether a "
        "subgoal is complete is judged by somebody else; you are asked once it is, and name the next one.",
        *what_there_is(task, kind),
        "Notes are of three kinds. A count says how often something has been done; it may stay or grow by one. An "
        "identity says which thing is meant, in words that tell it from the others, where it is now. A route is a list "
        "of steps that never changes, and how many of them are done. A note with a name that is there already takes "
        "its place.",
        'Answer with JSON alone: {"notes": [{"kind": "count", "name": "cubes in the bin", "value": 1}, {"kind": '
        '"identity", "name": "the container with the red cube", "words": "the left one of the two in front"}, {"kind": '
        f'"route", "name": "the pattern", "steps": ["move left"], "done": 0}}], "subgoal": "{example}"}}. Leave '
        '"notes" empty where there is nothing to write.',
    ]
    return "\n\n".join(parts)


def opening_query(goal: str, video: bool) -> str:
    """The planner's first question; its pictures come before it, the demonstration video first."""
    shown = (
        "The video shows what happened before the robot's turn, the picture shows the scene now. Note what has to be "
        "remembered of the video."
        if video
        else "The picture shows the scene at the start."
    )
    return f"The task: {goal}\n{shown} Name the first subgoal."


def next_query(goal: str, finished: str, notes: str, clip: bool) -> str:
    """A later question to the planner; the video of the finished subgoal, if it has frames, comes before it."""
    shown = "The picture shows the scene now."
    if clip:
        shown = "The video shows how it was done, the picture the scene now."
    return (
        f"The task: {goal}\nYour notebook:\n{notes}\nThe subgoal {finished!r} is complete. {shown} Bring the notebook "
        "up to date, and name the next subgoal."
    )


def monitor_query(goal: str, subgoal: str, clip: bool) -> str:
    """A question to the monitor; its pictures come before it."""
    shown = (
        "The video shows what the robot did since it was given the subgoal, the picture the scene now."
        if clip
        else "The picture shows the scene now."
    )
    return f"The task: {goal}\nThe subgoal: {subgoal}\n{shown} Is the subgoal complete?"
