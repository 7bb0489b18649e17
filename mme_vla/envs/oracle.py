"""The action that a task's own script takes next, by choices: what a player or a learner can be
taught by.
"""

from typing import Any, NoReturn

import numpy as np

from mme_vla.embodiment.robomme import SIDE
from mme_vla.envs.grounding import project


class OracleStuckError(Exception):
    """The script has no next action; the message says why."""


def oracle_choice(task: Any) -> tuple[dict[str, Any], str]:
    """The option that carries out the current sub-task, on the object it is about.

    Args:
        task: a running task (`Task`), whose state is read.

    Returns:
        `{"choice": letter, "point": [y, x] or None}`, the point in pixels of the front image, and
        the sub-task's text.

    Raises:
        OracleStuckError: no option does it.
    """
    subtask = task.progress.current
    if subtask is None:
        _stuck("every sub-task is done, but the episode has not ended")
    if subtask.video:
        _stuck(
            f"the conditioning video did not succeed ({subtask.text!r}), so the task cannot be done"
        )
    choices = [choice for choice in task.choices() if choice.label == subtask.choice]
    if not choices:
        _stuck(f"the sub-task {subtask.text!r} has no option")
    choice = choices[-1]
    if choice.candidates is None:
        return {"choice": choice.label, "point": None}, subtask.text
    # A sub-task may name the button it ends at as well: the point is of what the option chooses
    # among.
    candidates = {id(candidate) for candidate in choice.candidates}
    targets = [thing for thing in subtask.targets if id(thing) in candidates]
    if not targets:
        _stuck(f"the sub-task {subtask.text!r} is about nothing that its option can choose")
    pixel = np.clip(np.rint(project(targets[0].position)), 0, SIDE - 1)
    return {"choice": choice.label, "point": pixel.tolist()}, subtask.text


def _stuck(reason: str) -> NoReturn:
    raise OracleStuckError(f"the oracle is stuck: {reason}")
