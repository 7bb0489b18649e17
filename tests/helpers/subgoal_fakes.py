"""A stand-in for google-genai's client, and episodes to ask it about."""

from types import SimpleNamespace

import numpy as np

from mme_vla.subgoal import Gemini


class ApiError(Exception):
    """Looks like google-genai's."""

    def __init__(self, code, message=""):
        super().__init__(f"{code} {message}")
        self.code = code


def response(text, *, finish="STOP", blocked=None):
    return SimpleNamespace(
        text=text,
        usage_metadata=SimpleNamespace(
            prompt_token_count=1000, candidates_token_count=20, thoughts_token_count=80
        ),
        candidates=[SimpleNamespace(finish_reason=SimpleNamespace(name=finish))],
        prompt_feedback=SimpleNamespace(block_reason=blocked),
    )


def says(subgoal):
    return response(f'```json\n{{"description": "x",\n "subgoal": "{subgoal}"}}\n```')


class Client:
    """Has google-genai's interface; returns these outcomes in turn (exceptions are raised,
    functions called).
    """

    def __init__(self, *outcomes):
        self.outcomes, self.requests = list(outcomes), []
        self.models = self

    def generate_content(self, *, model, contents, config):
        self.requests.append((contents, config))
        outcome = self.outcomes.pop(0)
        if callable(outcome):
            outcome = outcome()
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


def predictor_of(*outcomes, **options):
    client = Client(*outcomes)
    return Gemini(client=client, **{"backoff": 0, "requests_per_minute": None, **options}), client


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


def kinds(parts):
    return [part["inline_data"]["mime_type"] if "inline_data" in part else "text" for part in parts]
