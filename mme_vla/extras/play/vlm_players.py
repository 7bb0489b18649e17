"""Vision-language models that play: Qwen3-VL on this machine, and models behind an endpoint."""

import math
import re
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from mme_vla.embodiment.action_space import Option
from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError, brief
from mme_vla.extras.play.game import ChoiceSession, Decision
from mme_vla.extras.play.players import PLAYERS, NoChoiceError, Player
from mme_vla.subgoal.base import Usage
from mme_vla.subgoal.clips import Clip, sample_video
from mme_vla.subgoal.models.api import ApiFailure, MediaPart, Message, make_api
from mme_vla.subgoal.models.qwen3vl import TOKEN_SIDE, VIDEO_TOKENS, VLM, Question
from mme_vla.subgoal.text import IMAGE, THOUSAND, VIDEO, MalformedReply, to_pixels, to_thousandths
from mme_vla.utils import parse_json

_OBJECT = re.compile(r"\{[^{}]*\}")

SYSTEM = """You decide what a robot arm does next. A task is described in words; it cannot be solved from the present \
image alone, but from what the clips have shown so far. All images come from one fixed camera in front of the robot.

Each time you get the frames since your last decision and choose exactly one option. A planner then carries it out \
without fault, so only your choice counts. Options marked [point] need the place of the object you mean in the present \
image: the candidate nearest to it is taken.

A point is [row, column], both from 0 (top, left) to 1000 (bottom, right).
End your answer with one JSON object and nothing after it: {"choice": "<letter>", "point": [row, column]}. \
Leave "point" as null for options without [point]."""  # noqa: E501


def option_list(options: Sequence[Option]) -> str:
    """`a: pick up the cube [point]`, one a line."""
    lines = []
    for option in options:
        mark = " [point]" if option.needs_point else ""
        lines.append(f"{option.label}: {option.action}{mark}")
    return "\n".join(lines)


def choice_text(decision: Decision) -> str:
    """A past decision in words: `a: pick up the cube at [442, 617]`."""
    text = f"{decision.choice}: {decision.action}"
    if decision.point is not None:
        row, column = decision.point
        text += f" at [{to_thousandths(int(row))}, {to_thousandths(int(column))}]"
    return text


def opening(goal: str, options: Sequence[Option], video: bool) -> str:
    """The first question of a conversation."""
    introduction = "This is the present image."
    if video:
        introduction = "The video comes before you act; the image is the present one."
    return f"The task: {goal}\n{introduction}\nOptions:\n{option_list(options)}\nWhat next?"


def following(decision: Decision, options: Sequence[Option], changed: bool) -> str:
    """A later question of a conversation."""
    description = "nothing moved; this is the present image"
    if changed:
        description = "the video shows it, the image is the present one"
    return (
        f"You chose {choice_text(decision)}; {description}.\nOptions:\n{option_list(options)}\nWhat"
        " next?"
    )


def parse_choice(reply: str, options: Sequence[Option]) -> dict[str, Any]:
    """Read a reply: the last JSON object in it, whatever stands before.

    Returns:
        {"choice": letter, "point": [y, x] in pixels or None}.

    Raises:
        MalformedReply: no object, an unknown option, or a point that is missing or none.
    """
    fields: dict[str, Any] = {}
    for text in reversed(_OBJECT.findall(reply)):
        with suppress(UserError):
            fields = parse_json(text, "the answer", finite=False)
        if fields:
            break
    letter = fields.get("choice")
    label = letter.strip().strip("().:[]").lower() if isinstance(letter, str) else None
    option = next((option for option in options if option.label == label), None)
    if not reply.strip():
        raise MalformedReply("the answer is empty")
    if not fields:
        raise MalformedReply("the answer holds no JSON object")
    if label is None:
        raise MalformedReply('the answer has no "choice"')
    if option is None:
        labels = ", ".join(option.label for option in options)
        raise MalformedReply(f"there is no option {brief(letter)}; the options are {labels}")
    if not option.needs_point:
        return {"choice": label, "point": None}
    problem = _misfit(fields.get("point"), option)
    if problem is not None:
        raise MalformedReply(problem)
    point = [min(to_pixels(value), SIDE - 1) for value in fields["point"]]
    return {"choice": label, "point": point}


def _misfit(point: Any, option: Option) -> str | None:
    if not isinstance(point, list) or len(point) != 2:
        return f'option {option.label} needs "point": [row, column]'
    for value in point:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        # `math.isfinite` takes no integer that is too large for a float.
        if not is_number or value != value or abs(value) == math.inf:
            return "a point is made of two numbers"
    if not all(0 <= value <= THOUSAND for value in point):
        return f"a point lies within 0 and {THOUSAND}"
    return None


class ModelPlayer(Player):
    """A model that makes each choice, with retries where its reply cannot be used.

    model: its name.
    tries: replies that may be unusable in a row; then the episode counts as failed.
    """

    def __init__(self, model: str, tries: int = 3) -> None:
        if isinstance(tries, bool) or not isinstance(tries, int) or tries < 1:
            raise UserError(f"player.tries={tries!r} must be a positive number of replies.")
        self.model, self.tries = model, tries
        self.usage = Usage()
        self._before = Usage()

    def start(self, session: ChoiceSession) -> None:
        self._before = replace(self.usage, problems=self.usage.problems.copy())

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        replies: list[str] = []
        complaint = ""
        for _ in range(self.tries):
            reply = self.ask(session, complaint)
            replies.append(reply)
            try:
                action = parse_choice(reply, session.options)
            except MalformedReply as error:
                self.usage.problems["malformed" if reply.strip() else "empty"] += 1
                complaint = (
                    f"Your last answer could not be used: {error}. Answer again, ending with one"
                    ' JSON object {"choice": "<letter>", "point": [row, column] or null}.'
                )
            else:
                return action, {"answers": replies}
        raise NoChoiceError(
            "fail",
            f"{self.tries} replies in a row could not be used; the last one: {replies[-1]!r}",
        )

    def ask(self, session: ChoiceSession, complaint: str) -> str:
        """The model's reply to the present question, verbatim.

        complaint: why its last reply to the same question could not be used; empty the first time.

        Raises:
            NoChoiceError: the model sent no reply.
        """
        raise NotImplementedError

    def notes(self) -> dict[str, Any]:
        """Calls, tokens and unusable replies of the episode."""
        now = self.usage.to_dict()
        before = self._before.to_dict()
        used = {name: now[name] - before[name] for name in now if name != "problems"}
        used["seconds"] = round(used["seconds"], 6)
        used["problems"] = dict(self.usage.problems - self._before.problems)
        return {"usage": used}


@PLAYERS.register("qwenvl")
class QwenPlayer(ModelPlayer):
    """Reads the whole episode anew at each decision: a clip for each motion, and the present image.

    Args:
        model: a repository on the hub, a folder, or `tiny`.
        adapter: LoRA weights to add; None for none.
        tries: replies that may be unusable in a row.
        max_new_tokens: longest reply.
        clip_frames: most frames of a clip that the model reads.
        device, dtype: where and how it runs.
        vlm: a model that is loaded already, instead of all these.
    """

    def __init__(
        self,
        model: str = "Qwen/Qwen3-VL-4B-Instruct",
        adapter: str | None = None,
        tries: int = 3,
        max_new_tokens: int = 512,
        clip_frames: int = 16,
        device: str = "auto",
        dtype: str = "bfloat16",
        vlm: VLM | None = None,
    ) -> None:
        super().__init__(model if adapter is None else f"{model}+{adapter}", tries)
        if clip_frames < 2 or clip_frames % 2:
            raise UserError(
                f"player.clip_frames={clip_frames} must be even and at least 2: frames are read in"
                " pairs."
            )
        self.max_new_tokens, self.clip_frames = max_new_tokens, clip_frames
        self.vlm = vlm or VLM.load(model, adapter, device=device, dtype=dtype, batch_size=1)
        # The processor would shrink the frames of a clip that has more of them than the subgoal
        # predictors read.
        area = TOKEN_SIDE**2
        most = clip_frames * VIDEO_TOKENS * area
        self.vlm.processor.video_processor.size = {"shortest_edge": 4 * area, "longest_edge": most}

    def ask(self, session: ChoiceSession, complaint: str) -> str:
        started = time.perf_counter()
        (completion,) = self.vlm.generate([self.question(session, complaint)], self.max_new_tokens)
        self.usage.seconds += time.perf_counter() - started
        self.usage.calls += 1
        self.usage.input_tokens += completion.input_tokens
        self.usage.output_tokens += completion.output_tokens
        return completion.text

    def question(self, session: ChoiceSession, complaint: str = "") -> Question:
        """One question that tells the whole episode, `<video>` and `<image>` where images go.

        complaint: why the last reply to the same question could not be used; empty the first time.
        """
        first, *motions = session.reveals
        titled_clips: list[tuple[str, list[np.ndarray]]] = []
        if len(first.frames) > 1:
            titled_clips.append(("The video that comes before you act", list(first.frames[:-1])))
        for reveal, decision in zip(motions, session.decisions, strict=True):
            titled_clips.append((f"You chose {choice_text(decision)}", list(reveal.frames)))
        lines = [f"The task: {session.goal}"]
        clips: list[Clip] = []
        for title, frames in titled_clips:
            if not frames:
                lines.append(f"{title}: nothing moved.")
                continue
            lines.append(f"{title}: {VIDEO}")
            indices = sample_video(len(frames), most=self.clip_frames)
            clips.append(Clip(np.stack([frames[i] for i in indices]), indices, len(frames)))
        lines += [f"The present image: {IMAGE}", "Options:", option_list(session.options)]
        if complaint:
            lines.append(complaint)
        lines.append("What next?")
        return Question(SYSTEM, "\n".join(lines), [session.frame], clips)


@PLAYERS.register("openai")
class OpenAIPlayer(ModelPlayer):
    """One conversation an episode: each turn brings the frames since the last decision.

    The model is behind an endpoint for OpenAI's chat completions. Videos are shown as images.

    Args:
        tries: replies that may be unusable in a row.
        client: an object with openai's `chat.completions.create`; None makes one.
        settings: keys of `mme_vla.subgoal.models.api.Settings`.
    """

    provider = "openai"

    def __init__(self, tries: int = 3, client: Any = None, **settings: Any) -> None:
        super().__init__("", tries)
        self.api = make_api(self.provider, settings, "player", self.usage, client)
        self.model = self.api.settings.model
        self._conversation: list[Message] = []
        self._unanswered: Message | None = None

    def start(self, session: ChoiceSession) -> None:
        super().start(session)
        self._conversation = []
        self._unanswered = None

    def ask(self, session: ChoiceSession, complaint: str) -> str:
        message: Message = ("user", [complaint])
        if not complaint:
            # The frames since the last decision, then the present one
            if session.decisions:
                frames = list(session.reveals[-1].frames)
                text = following(session.decisions[-1], session.options, len(frames) > 0)
            else:
                frames = list(session.reveals[0].frames[:-1])
                text = opening(session.goal, session.options, len(frames) > 0)
            parts: list[str | MediaPart] = [MediaPart(session.frame), text]
            if frames:
                parts.insert(0, MediaPart(np.stack(frames)))
            message = ("user", parts)
        elif self._unanswered is not None:
            message = self._unanswered
        self._unanswered = None
        try:
            reply = self.api.ask(SYSTEM, [*self._conversation, message])
        except ApiFailure as failure:
            if failure.problem == "empty":
                # An empty answer is no turn of a conversation: the question is asked once more.
                self._unanswered = message
                return ""
            self.usage.problems[failure.problem] += 1
            # A refusal counts as a failure of the model; an episode with a network error is
            # repeated by `retry_errors`.
            outcome = "error" if failure.problem == "failed" else "fail"
            raise NoChoiceError(outcome, f"no answer ({failure.problem}): {failure}") from None
        self._conversation += [message, ("model", [reply.text])]
        return reply.text


@PLAYERS.register("gemini")
class GeminiPlayer(OpenAIPlayer):
    """As `OpenAIPlayer`, with the defaults of Google's endpoint."""

    provider = "gemini"
