"""A stand-in for the client of the package `openai`, and episodes to ask it about."""

from types import SimpleNamespace

import numpy as np

from mme_vla.subgoal import Gemini


class ApiError(Exception):
    """Looks like that of the package `openai`."""

    def __init__(self, code, message=""):
        super().__init__(f"{code} {message}")
        self.status_code = code


def response(text, *, finish="stop", refusal=None):
    message = SimpleNamespace(content=text, refusal=refusal)
    return SimpleNamespace(
        choices=[SimpleNamespace(message=message, finish_reason=finish)],
        usage=SimpleNamespace(prompt_tokens=1000, completion_tokens=100),
    )


def says(subgoal):
    return response(f'```json\n{{"description": "x",\n "subgoal": "{subgoal}"}}\n```')


class Client:
    """Has openai's interface; returns these outcomes in turn (exceptions are raised,
    functions called).
    """

    def __init__(self, *outcomes):
        self.outcomes, self.requests = list(outcomes), []
        self.chat = SimpleNamespace(completions=self)

    def create(self, **request):
        self.requests.append(request)
        outcome = self.outcomes.pop(0)
        if callable(outcome):
            outcome = outcome()
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


def predictor_of(*outcomes, **options):
    client = Client(*outcomes)
    return Gemini(client=client, **options), client


def frames(count, first=0, size=32):
    """Images that show their number in every pixel."""
    return np.stack([np.full((size, size, 3), (first + t) % 256, np.uint8) for t in range(count)])


def started(predictor, task="StopCube", video=0):
    episode = predictor.start_episode("stop the cube", frames(video) if video else None, task)
    episode.observe(frames(1))
    return episode


def play(predictor, episode, chunks):
    """Predict, then execute 16 actions; returns the subgoals and the steps at which the model was
    asked.
    """
    texts, queries = [], []
    for _ in range(chunks):
        subgoal = predictor.predict([episode])[0]
        texts.append(subgoal)
        queries += [episode.step] if subgoal.queried else []
        episode.observe(frames(16, episode.n_observed_frames))
    return texts, queries


def turns(request):
    """The messages of a request without the system prompt."""
    return request["messages"][1:]


def kinds(message):
    """What a message shows, in order: `image`, `video of N`, or `text`; a video's images apart."""
    displayed = []
    for part in message["content"]:
        text = part.get("text", "")
        if part["type"] == "image_url":
            displayed.append("image")
        elif text.startswith("A video of"):
            displayed.append(f"video of {text.split()[3]}")
        else:
            displayed.append("text")
    return displayed
