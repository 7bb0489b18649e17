"""What a card from outside says of a policy, in plain words."""

from dataclasses import dataclass
from functools import cache

from mme_vla.errors import counted
from mme_vla.evaluation.records import EpisodeKey
from mme_vla.extras.audit.floor import RANDOM
from mme_vla.extras.probing.card import CONTENT, TIME, WRONG_SCENE, Card, grade, percent

FORGET = "nothing remembered"
NO_VIDEO = "no video"
ORDER = "order-broken"
REPLAY = "own chunks lost"
LAST = "last frames pushed out"
GOAL = "another goal"
STATE = "state frozen"
INTERVENTIONS = {
    FORGET: "forget",
    NO_VIDEO: "nodemo",
    CONTENT: "swap_frames",
    ORDER: "shuffle_frames",
    TIME: "pause:64",
    LAST: "linger:16",
    REPLAY: "replay",
    WRONG_SCENE: "distract:1",
    GOAL: "goal_swap",
    STATE: "freeze_state",
}
"""What an audit changes of what a policy is sent, and the interventions that do it."""
OF_HISTORY = (FORGET, NO_VIDEO, CONTENT, TIME, REPLAY)
"""Changes of which each alone shows that something before the current frame is read."""

VERDICTS = {
    "nothing": "It shows no sign of memory: nothing that came before the current frame matters.",
    "goal": "It shows no sign of memory, and acts on the goal and the current frame.",
    "clock": (
        "It reads time, not content: it acts by how many frames have passed, whatever they show."
    ),
    "own chunks": (
        "It reads what it did itself: with all frames but without its own chunks it acts otherwise,"
        " and what past frames show does not matter."
    ),
    "last frames": "It remembers the last frames alone: repeating the current one makes it forget.",
    "content": "It reads what past frames show.",
    "history": "It reads its history, and these changes do not tell what of it.",
    "unsolved": "Nothing can be said: it solves too few scenes.",
}
"""Name → sentence of what an audit can find."""


@dataclass(frozen=True)
class Conclusion:
    """What an audit found.

    verdict: of `VERDICTS`.
    sentences: the verdict and the losses that it follows from.
    resolution: the smallest share of scenes whose loss can be told from chance; None where no loss
        can.
    """

    verdict: str
    sentences: tuple[str, ...]
    resolution: float | None


@cache
def resolution(scenes: int, tasks: int) -> float:
    """The smallest loss, as a share of so many scenes, that a card tells from no loss; infinite
    where none is.

    It is the loss of scenes that the matched run solves and an arm never gains one. Scenes, and the
    lost ones among them, are spread evenly over the tasks, within which a card resamples.
    """
    keys = [EpisodeKey(str(number % tasks), number) for number in range(scenes)]
    solved = dict.fromkeys(keys, 1.0)
    for lost in range(1, scenes + 1):
        arm = solved | dict.fromkeys(keys[:lost], 0.0)
        loss = grade(solved, {"": arm}, solved).arms[""]
        if loss.beyond_noise:
            return loss.loss
    return float("inf")


def conclude(card: Card, target_loss: float, tasks: int) -> Conclusion:
    """The conclusion of a card whose interventions are `INTERVENTIONS`.

    target_loss: the loss that was to be resolved.
    tasks: how many the scenes are of.
    """
    limit_of_scenes = resolution(card.scenes, tasks)
    verdict = _verdict(card, limit_of_scenes)
    finest = max(limit_of_scenes, card.noise)
    sentences = [VERDICTS[verdict]]
    for label in (FORGET, NO_VIDEO, CONTENT, TIME, REPLAY, LAST, GOAL):
        if _loses(card, label):
            loss = card.arms[label]
            sentences.append(
                f"With {label} it solves {percent(loss.success)} instead of"
                f" {percent(card.matched)} (loss {percent(loss.loss)}, 95 % interval"
                f" {percent(loss.low)} to {percent(loss.high)})."
            )
    if verdict == "content" and _loses(card, TIME):
        sentences.append("It finds what it needs by time: shifted frames mislead it too.")
    if card.references and RANDOM in card.references:
        solved = percent(card.references[RANDOM])
        sentences.append(f"It solves {percent(card.matched)}, and actions at random {solved}.")
    unresolved = [label for label, loss in card.arms.items() if not loss.beyond_noise]
    if unresolved:
        limit = f"one below {percent(finest)} cannot be told here"
        if finest > 1:
            limit = "none can be told here"
        sentences.append(f"No loss beyond noise with {', '.join(unresolved)}: {limit}.")
    if finest > target_loss:
        sentences.append(
            f"resolve={target_loss:g} was not reached with {counted(card.scenes, 'scene')} and a"
            f" noise of {percent(card.noise)}: give more scenes (episodes=…, minutes=…)."
        )
    return Conclusion(verdict, tuple(sentences), finest if finest <= 1 else None)


def _verdict(card: Card, limit_of_scenes: float) -> str:
    if card.matched < limit_of_scenes:
        return "unsolved"
    if not any(_loses(card, label) for label in OF_HISTORY):
        return "goal" if _loses(card, GOAL) else "nothing"
    if _loses(card, CONTENT):
        # Memory of the last frames alone goes with the next ones, whatever the clock says.
        is_short = _loses(card, LAST) and not _loses(card, TIME)
        return "last frames" if is_short else "content"
    if _loses(card, TIME):
        return "clock"
    if _loses(card, REPLAY):
        return "own chunks"
    return "history"


def _loses(card: Card, label: str) -> bool:
    return label in card.arms and card.arms[label].beyond_noise
