"""Digests of what a seed means beside scenes: noise, order of samples, bootstraps, tokens.

`python -m helpers.number_digests` prints them as JSON.
"""

import hashlib
import json
from collections.abc import Iterable

import numpy as np
import torch

from mme_vla.backbone.flow import FlowHead
from mme_vla.evaluation.results.statistics import resampled_means
from mme_vla.processing.prompt import PromptInput, State
from mme_vla.processing.tokenizer import Tokenizer
from mme_vla.training.order import BatchOrder, generator_for


def digest(parts: Iterable[bytes]) -> str:
    return hashlib.sha256(b"|".join(parts)).hexdigest()[:16]


def noise() -> str:
    head = FlowHead(20, 8, deviation=0.1)
    training = head.training_noise(64, generator_for(7, "noise", 3))
    sampling = head.sampling_noise(generator_for(7, "act", 3))
    return digest(
        value.numpy().tobytes()
        for part in (training, sampling)
        for _, value in sorted(part.items())
    )


def order() -> str:
    batches = BatchOrder(samples=1003, batch_size=16, seed=42, steps=range(200))
    return digest(str(batches.batch(step)).encode() for step in range(200))


def bootstraps() -> str:
    outcomes = np.random.default_rng(5).integers(0, 2, (2, 50)).astype(float)
    means = resampled_means({"one": [outcomes[0]], "two": [outcomes[1]]}, samples=1000, seed=3)
    return digest([means.tobytes()])


def tokens() -> str:
    tokenizer, state = Tokenizer.load("sample"), np.linspace(-1.2, 1.2, 500)
    pieces = State().pieces(
        PromptInput("watch the video, then pick up the green cube", state=state)
    )
    return digest(str(tokenizer.encode(text, bos)).encode() for text, bos in pieces)


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(
        json.dumps(
            {"noise": noise(), "order": order(), "bootstraps": bootstraps(), "tokens": tokens()}
        )
    )
