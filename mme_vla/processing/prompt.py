"""What the policy is reported. A format is one class here; everything else refers to it by name."""

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.config.sections import NonNegativeInt, Range, read_section
from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, brief
from mme_vla.processing.tokenizer import Tokenizer
from mme_vla.registry import PROMPTS
from mme_vla.utils import is_text

BINS = 256

_warned: set[object] = set()  # what was said already, in this process

Piece = tuple[str, bool]  # a text, and whether a beginning-of-sequence token precedes it


@dataclass(frozen=True)
class PromptInput:
    """What a prompt may be made of.

    goal: the task in words.
    subgoal: the language subgoal of this step, None if there is none.
    state: [d] normalised state, None if unknown.
    past_actions: [n, d] normalised actions executed last, oldest first; empty before the first.
    """

    goal: str
    subgoal: str | None = None
    state: np.ndarray | None = None
    past_actions: np.ndarray | None = None


class PromptFormat:
    """The interface of a prompt format.

    A subclass sets what it reads beside the goal and implements `pieces`.
    """

    reads_subgoal: bool = False
    reads_state: bool = False
    past_actions: int = 0  # how many executed actions it reads

    def pieces(self, inputs: PromptInput) -> list[Piece]:
        """Return the texts in order; each is tokenised by itself."""
        raise NotImplementedError


@PROMPTS.register("plain")
class GoalPrompt(PromptFormat):
    """The goal and a newline: π0.5 without state in the prompt, and every policy with a neural
    memory.
    """

    def pieces(self, inputs: PromptInput) -> list[Piece]:
        """Return the goal, then the newline, which is tokenised apart."""
        return [(_one_line(inputs.goal), True), ("\n", False)]


@PROMPTS.register("state")
class State(PromptFormat):
    """The goal and the state as 256-level numbers, as released (openpi's own π0.5 has a comma for
    the semicolon).
    """

    reads_state = True

    def pieces(self, inputs: PromptInput) -> list[Piece]:
        if inputs.state is None:
            raise UserError(
                "The prompt format 'state' needs the robot's state; give one, or choose the format"
                " 'plain'."
            )
        levels = " ".join(map(str, discretize(inputs.state)))
        return [(f"Task: {_one_line(inputs.goal)}; State: {levels};\nAction: ", True)]


@PROMPTS.register("subgoal")
class Subgoal(PromptFormat):
    """The goal and the language subgoal: symbolic memory, as released.

    Where a step has no subgoal the prompt is the plain one (as released), with one warning.
    """

    reads_subgoal = True

    def pieces(self, inputs: PromptInput) -> list[Piece]:
        """Return one text, or the plain pieces if there is no subgoal."""
        if inputs.subgoal is None:
            warn_once(
                "The prompt format 'subgoal' got no subgoal: such steps use the plain prompt, as"
                " released."
            )
            return GoalPrompt().pieces(inputs)
        goal, subgoal = _one_line(inputs.goal), _one_line(inputs.subgoal)
        return [(f"Task: {goal};\nCurrent Subgoal: {subgoal};\nAction: ", True)]


@PROMPTS.register("subgoal_sentence")
class SubgoalSentence(Subgoal):
    """The goal and the subgoal with the punctuation of the real-robot release, which has a state
    but leaves it out.
    """

    def pieces(self, inputs: PromptInput) -> list[Piece]:
        """Return one text, or the plain pieces if there is no subgoal."""
        if inputs.subgoal is None:
            return super().pieces(inputs)
        goal, subgoal = _one_line(inputs.goal), _one_line(inputs.subgoal)
        return [(f"Task: {goal}\nCurrent Subgoal: {subgoal}.\nAction: ", True)]


@PROMPTS.register("past_actions")
class PastActions(PromptFormat):
    """The goal and the last 16 executed actions as 256-level numbers: the memory baseline after
    UniVLA.

    An action is written in the units of the chunk, joints relative to the current state. Before the
    first action the list is empty.
    """

    past_actions = 16

    def pieces(self, inputs: PromptInput) -> list[Piece]:
        if inputs.past_actions is None:
            raise UserError(
                "The prompt format 'past_actions' needs the executed actions (none yet: an empty"
                " array [0, w])."
            )
        levels = " ".join(map(str, discretize(inputs.past_actions.reshape(-1))))
        return [(f"Task: {_one_line(inputs.goal)}; Past actions: {levels};\nAction: ", True)]


def discretize(values: np.ndarray) -> list[int]:
    """Map each normalised number, clipped to [-1, 1], to its level 0…255."""
    edges = np.linspace(-1, 1, BINS + 1)[:-1]
    return (np.digitize(np.clip(values, -1, 1), edges) - 1).tolist()


GOAL_CASES = ("given", "lower")
"""How a goal is spelled when acting; in training goals are lower-case."""


def goal_case(robot: Embodiment) -> str:
    """How a new policy of this robot spells goals when acting.

    A robot of one's own: as in training. The benchmark's: as they are given, as in the released
    code.
    """
    if robot.action.space is None:
        return "lower"
    return "given"


def spelled(text: str, case: str) -> str:
    """A goal or subgoal in one of `GOAL_CASES`."""
    return text.lower() if case == "lower" else text


def checked_goal(text: object) -> str:
    """`text`, if it can tell a policy what to do.

    Raises:
        UserError: it is no text, holds half a character, or nothing but spaces.
    """
    goal = checked_text(text, "the goal")
    if not goal.strip():
        raise UserError(
            f"The goal is {goal!r}: a policy is told what to do in words. Give the task as a text."
        )
    return goal


def checked_text(text: object, what: str) -> str:
    """`text`, if a tokenizer can take it."""
    if not isinstance(text, str):
        raise UserError(f"{what} must be a text, got {brief(text)}.")
    if not is_text(text):
        raise UserError(
            f"{what} holds half a character (a lone surrogate), which cannot be written:"
            f" {brief(text)}."
        )
    return text


def encode_prompt(
    prompt_format: PromptFormat, tokenizer: Tokenizer, inputs: PromptInput, max_length: int
) -> tuple[Tensor, Tensor]:
    """Turn a prompt into token ids.

    Args:
        prompt_format: which texts to build (`PROMPTS[name]()`).
        tokenizer: its ids.
        inputs: what the texts are made of.
        max_length: l; a longer prompt loses its end, with one warning.

    Returns:
        ids [l] int64, padded on the right with 0; mask [l] bool, False on the padding.
    """
    tokens: list[int] = []
    for text, bos in prompt_format.pieces(inputs):
        tokens += tokenizer.encode(text, bos=bos)
    if len(tokens) > max_length:
        warn_once(
            f"A prompt has more tokens than processor.prompt_length={max_length} and loses its end,"
            " such as the newest of past actions; raise processor.prompt_length. The first one,"
            f" {len(tokens)} tokens long: {brief(inputs.goal, 200)}.",
            key=("truncated", max_length),
        )
        tokens = tokens[:max_length]
    ids = torch.zeros(max_length, dtype=torch.int64)
    ids[: len(tokens)] = torch.tensor(tokens, dtype=torch.int64)
    return ids, torch.arange(max_length) < len(tokens)


def shorten(text: str, tokenizer: Tokenizer, length: int | None) -> str:
    """Cut a text to its first `length` tokens, with one warning; None leaves it as it is."""
    tokens = tokenizer.encode(text, bos=False)
    if length is None or len(tokens) <= length:
        return text
    warn_once(
        f"A subgoal has more tokens than subgoal_length={length} and loses its end. The first one:"
        f" {brief(text, 200)}.",
        key=("shortened", length),
    )
    return tokenizer.decode(tokens[:length])


def _one_line(text: str) -> str:
    return text.strip().replace("_", " ").replace("\n", " ")


def warn_once(message: str, key: object = None) -> None:
    """Warn the first time that this process has this key, by default the message."""
    if (key or message) not in _warned:
        _warned.add(key or message)
        warnings.warn(message, stacklevel=3)


POINT = re.compile(r"at <(-?\d+), (-?\d+)>")
STD_PER_LIMIT = 1 / 2.5  # the noise's standard deviation, as a share of where it is cut off


@dataclass(frozen=True)
class SubgoalText:
    """Chooses the text of one training step, as released. `from_config` checks its values.

    kind: `simple_subgoal` or `grounded_subgoal`.
    online_probability: how often the label is the one the simulator reports at test time
        (`<kind>_online`), which switches a little earlier than the planner's. Without that column
        it is always the planner's.
    point_noise: pixels; a text with exactly one point `at <y, x>` gets Gaussian noise on both
        numbers, cut off here and rounded. 0 adds none. The result may leave the image, as released.
    """

    kind: Literal["simple_subgoal", "grounded_subgoal"]
    online_probability: Annotated[float, Range(0, 1)] = 0.5
    point_noise: NonNegativeInt = 8

    @classmethod
    def from_config(cls, config: Mapping[str, Any] | None) -> Self | None:
        """Build from the section `subgoal_text`, or return None where there is none."""
        if not config:
            return None
        return read_section(cls, config, "subgoal_text")

    def __call__(self, texts: Mapping[str, str], rng: np.random.Generator) -> str:
        """Choose among a step's `texts`, by column name, and perturb the point."""
        text = texts[self.kind]
        if rng.random() < self.online_probability:
            text = texts.get(f"{self.kind}_online", text)
        if self.point_noise:
            text = perturb_point(text, self.point_noise, rng)
        return text


def perturb_point(text: str, limit: int, rng: np.random.Generator) -> str:
    """Move the one point of a text by up to `limit` pixels; a text with no point or several stays
    as it is.
    """
    if len(POINT.findall(text)) != 1:
        return text
    shift = np.clip(rng.normal(0, limit * STD_PER_LIMIT, 2), -limit, limit).round().astype(int)

    def shifted(match: re.Match[str]) -> str:
        y = int(match[1]) + int(shift[0])
        x = int(match[2]) + int(shift[1])
        return f"at <{y}, {x}>"

    return POINT.sub(shifted, text)


def subgoal_kind(policy: Any) -> str | None:
    """`simple_subgoal` or `grounded_subgoal`, as the policy was trained; None where it reads none.

    Args:
        policy: anything with a policy's processor and configuration.
    """
    if not policy.require_processor().prompt_spec.reads_subgoal:
        return None
    kind = (policy.config.get("subgoal_text") or {}).get("kind")
    return None if kind is None else str(kind)
