"""The cache's key of frame scores follows from the scorer's class, code and options."""

from dataclasses import dataclass

import numpy as np
import pytest

from mme_vla.errors import UserError
from mme_vla.memory.base import check_scorer
from mme_vla.memory.history import FrameScorer, score_frame
from mme_vla.memory.joined import _Upsampled
from mme_vla.memory.tokendrop import ChangeScorer, TokenDrop


class OtherRule(ChangeScorer):
    """Scores twice the change."""

    def __call__(self, frame_index: int, frame: np.ndarray) -> np.ndarray | None:
        values = super().__call__(frame_index, frame)
        return None if values is None else 2 * values


@dataclass
class Brightness(FrameScorer):
    """Mean of each frame."""

    every: int = 2

    def __call__(self, frame_index: int, frame: np.ndarray) -> np.ndarray | None:
        return None if frame_index % self.every else np.full(1, frame.mean(), np.float32)


def test_released_rule_keeps_the_key_of_earlier_caches() -> None:
    assert TokenDrop(64, 32).storage.scorer == ChangeScorer(8, 8).key == "change8x8-every8"


def test_another_rule_or_option_has_another_key() -> None:
    keys = {
        scorer.key
        for scorer in (
            ChangeScorer(8, 8),
            ChangeScorer(8, 4),
            OtherRule(8, 8),
            Brightness(),
            Brightness(3),
        )
    }
    assert len(keys) == 5
    assert Brightness().key.startswith("brightness-every2-")


class OtherTokenDrop(TokenDrop):
    """Scores by another rule, and forgets to store the scores under its key."""

    def make_scorer(self) -> OtherRule:
        return OtherRule(self.storage.grid, self.stride)


@pytest.mark.parametrize(("sides", "grid"), [((94, 130), 2), ((95, 128), 1), ((100, 64), 4)])
def test_an_image_that_does_not_divide_says_what_would_fit(
    sides: tuple[int, int], grid: int
) -> None:
    image = np.zeros((*sides, 3), np.uint8)
    for scorer in (ChangeScorer(8, 4), _Upsampled(ChangeScorer(8, 4), 8, 16)):
        with pytest.raises(UserError, match=f"multiples of 8, set memory.grid={grid}, or"):
            score_frame(scorer, 3, image)
        with pytest.raises(UserError, match="multiples of 8"):
            score_frame(scorer, 0, image)  # and not when the first frame that counts comes
    score_frame(ChangeScorer(grid, 4), 3, image)


def test_scores_under_the_key_of_another_rule_are_refused() -> None:
    check_scorer(TokenDrop(64, 32))
    with pytest.raises(UserError, match=r"scorer='change8x8-every8' is not the key of the scorer"):
        check_scorer(OtherTokenDrop(64, 32))


class NamingTokenDrop(TokenDrop):
    """Scores by another rule, named once."""

    Scorer = OtherRule


def test_a_token_drop_stores_and_makes_the_scorer_that_its_class_names() -> None:
    memory = NamingTokenDrop(64, 32, stride=4)
    check_scorer(memory)
    assert memory.make_scorer() == OtherRule(8, 4)
    assert memory.storage.scorer == OtherRule(8, 4).key != ChangeScorer(8, 4).key


def test_a_scorer_names_the_frames_that_it_needs() -> None:
    assert Brightness().frames_scored(4).tolist() == [0, 1, 2, 3], "all, unless it says otherwise"
    assert ChangeScorer(8, 4).frames_scored(9).tolist() == [0, 3, 7]
    assert TokenDrop(64, 32, stride=4).frames_read([8], 0).tolist() == [0, 3, 7]
