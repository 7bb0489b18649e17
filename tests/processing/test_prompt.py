"""Prompts hold exactly the released texts, and fit their length."""

import json
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from mme_vla.errors import UserError
from mme_vla.processing import prompt as module
from mme_vla.processing.prompt import PROMPTS, PromptInput, discretize, encode_prompt
from mme_vla.processing.tokenizer import Tokenizer


@pytest.fixture(autouse=True)
def warnings_are_fresh() -> Iterator[None]:
    module._warned.clear()
    yield
    module._warned.clear()


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    return Tokenizer.load("sample")


def format_for(case: dict) -> str:
    """The format that has what this golden case gives."""
    if case["subgoal"] is None:
        return "plain" if case["state"] is None else "state"
    return "subgoal" if case["state"] is None else "subgoal_sentence"


def test_pieces_are_the_golden_ones(parity: Path) -> None:
    cases = json.loads((parity / "pipeline_text.json").read_text())["prompt_encoding"]
    assert cases
    for case in cases:
        state = None if case["state"] is None else np.array(case["state"])
        pieces = PROMPTS[format_for(case)]().pieces(
            PromptInput(case["prompt"], case["subgoal"], state)
        )
        assert [list(piece) for piece in pieces] == case["encoded_pieces"]


def test_prompt_is_padded_on_the_right_with_zeros(tokenizer: Tokenizer) -> None:
    ids, mask = encode_prompt(PROMPTS["plain"](), tokenizer, PromptInput("press the button"), 16)
    length = int(mask.sum())
    assert (
        ids.shape == mask.shape == (16,) and ids.dtype == torch.int64 and mask.dtype == torch.bool
    )
    assert mask[:length].all() and not mask[length:].any() and not ids[length:].any()


def test_long_prompts_lose_their_end_with_one_warning(tokenizer: Tokenizer) -> None:
    prompt = PromptInput("pick up the red cube " * 10)
    with pytest.warns(UserWarning, match="prompt_length=8"):
        ids, mask = encode_prompt(PROMPTS["plain"](), tokenizer, prompt, 8)
    assert ids.shape == (8,) and mask.all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        encode_prompt(PROMPTS["plain"](), tokenizer, prompt, 8)


def test_past_actions_that_do_not_fit_are_reported_with_the_key(tokenizer: Tokenizer) -> None:
    past = np.random.default_rng(0).uniform(-1, 1, (16, 14))  # of a robot with two arms
    prompt = PromptInput("press the button", past_actions=past)
    with pytest.warns(UserWarning, match=r"the newest of past actions; raise processor\.prompt_le"):
        encode_prompt(PROMPTS["past_actions"](), tokenizer, prompt, 640)


def test_a_missing_subgoal_gives_the_goal_prompt_and_one_warning() -> None:
    prompt = PromptInput("press the button")
    with pytest.warns(UserWarning, match="no subgoal"):
        assert PROMPTS["subgoal"]().pieces(prompt) == PROMPTS["plain"]().pieces(prompt)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert PROMPTS["subgoal_sentence"]().pieces(prompt) == PROMPTS["plain"]().pieces(prompt)


def test_a_missing_state_is_refused() -> None:
    with pytest.raises(UserError, match="needs the robot's state"):
        PROMPTS["state"]().pieces(PromptInput("press the button"))


def test_state_levels_span_the_clipped_range() -> None:
    assert discretize(np.array([-9.0, -1.0, 0.0, 1.0, 9.0])) == [0, 0, 128, 255, 255]
