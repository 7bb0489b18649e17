"""Subgoals of each task, for the prompts of models that are not trained on them."""

from itertools import chain

_POINT = " at <y, x>"

# `@` marks where a grounded subgoal has a point. [ordinal]: first, second, …; [colour]: red, blue
# or green.
VOCABULARY: dict[str, tuple[str, ...]] = {
    "BinFill": (
        "pick up the [ordinal] [colour] cube@",
        "put it into the bin@",
        "press the button@",
    ),
    "PickXtimes": (
        "pick up the [colour] cube@ for the [ordinal] time",
        "place the [colour] cube onto the target@",
        "press the button to stop@",
    ),
    "SwingXtimes": (
        "pick up the [colour] cube@",
        "move to the top of the right-side target@ for the [ordinal] time",
        "move to the top of the left-side target@ for the [ordinal] time",
        "put the [colour] cube on the table",
        "press the button@",
    ),
    "StopCube": (
        "move to the top of the button@ to prepare",
        "remain static",
        "press the button to stop the cube on the target@",
    ),
    "ButtonUnmask": (
        "press the button@",
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "ButtonUnmaskSwap": (
        "press the first button@",
        "press the second button@",
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "VideoUnmask": (
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "VideoUnmaskSwap": (
        "pick up the container@ that hides the [colour] cube",
        "put down the container",
    ),
    "PickHighlight": (
        "press the button@",
        "pick up the [ordinal] highlighted cube@, which is [colour]",
        "place the cube onto the table",
    ),
    "VideoRepick": (
        "pick up the correct cube@ for the [ordinal] time",
        "put it down",
        "press the button@ to finish",
    ),
    "VideoPlaceButton": ("pick up the cube@", "place the cube onto the correct target@"),
    "VideoPlaceOrder": ("pick up the cube@", "place the cube onto the correct target@"),
    "MoveCube": (
        "close gripper and push the cube@ to the target@",
        "pick up the cube@",
        "place the cube onto the target@",
        "pick up the peg@",
        "hook the cube@ to the target@ with the peg",
    ),
    "InsertPeg": (
        "pick up the peg by grasping the near end@",
        "pick up the peg by grasping the far end@",
        "insert the peg from the left side of the box@",
        "insert the peg from the right side of the box@",
    ),
    "PatternLock": (
        "move forward",
        "move backward",
        "move left",
        "move right",
        "move forward-left",
        "move forward-right",
        "move backward-left",
        "move backward-right",
    ),
    "RouteStick": (
        "move to the nearest left target by circling around the stick clockwise",
        "move to the nearest left target by circling around the stick counterclockwise",
        "move to the nearest right target by circling around the stick clockwise",
        "move to the nearest right target by circling around the stick counterclockwise",
    ),
}

LATE = frozenset(
    {
        "BinFill",
        "PickXtimes",
        "SwingXtimes",
        "ButtonUnmask",
        "ButtonUnmaskSwap",
        "PickHighlight",
        "VideoRepick",
        "VideoPlaceButton",
        "VideoPlaceOrder",
        "MoveCube",
        "InsertPeg",
    }
)
"""Tasks whose second question waits: their first subgoal takes longer than one interval."""

_NOTES = {
    "PickHighlight": (
        "The scene changes while the robot acts: after the button is pressed, cubes are highlighted"
        " one after another for a short time. Remember which cubes they were, and in which order."
    ),
    "MoveCube": (
        "The video shows which of three ways to use: pushing, picking and placing, or hooking with"
        " the peg."
    ),
    "InsertPeg": (
        "The video shows which end of the peg is grasped and from which side it is inserted."
    ),
    "PatternLock": (
        "Directions are those of the robot's base. The camera faces the robot: forward, away from"
        " the robot, is down in the image, and the robot's left is on the right-hand side of the"
        " image."
    ),
    "RouteStick": (
        "Directions are those of the robot's base. The camera faces the robot, so the robot's left"
        " is on the right-hand side of the image, and turning is judged from above."
    ),
}


def describe_subgoals(task: str, kind: str) -> list[str]:
    """Return paragraphs on a task: its subgoals, what points are, and what is special about it.

    Args:
        task: its name; for an unknown one the subgoals of all tasks are listed.
        kind: `simple` or `grounded`.
    """
    templates = _templates(task, kind)
    parts = [
        "Subgoals of this task, to be used word for word ([ordinal] is first, second, third, …;"
        " [colour] is red, blue or green):\n" + "\n".join(f"- {text}" for text in templates)
    ]
    if kind == "grounded" and any(_POINT in text for text in templates):
        parts.append(
            "<y, x> is a point in the latest image: y is its row and x its column, whole numbers"
            " from 0 (top, left) to 1000 (bottom, right). Point at the middle of the object that is"
            " meant."
        )
    if task in _NOTES:
        parts.append(_NOTES[task])
    return parts


def example_of(task: str, kind: str) -> str:
    """Return one subgoal of a task, as a model is to write it."""
    example = _templates(task, kind)[0]
    example = example.replace("[ordinal]", "first").replace("[colour]", "red")
    return example.replace("<y, x>", "<512, 430>")


def _templates(task: str, kind: str) -> list[str]:
    """Return a task's subgoals; those of all tasks, each once, for an unknown one."""
    templates = VOCABULARY.get(task)
    if templates is None:
        templates = tuple(dict.fromkeys(chain.from_iterable(VOCABULARY.values())))
    point = _POINT if kind == "grounded" else ""
    return [template.replace("@", point) for template in templates]
