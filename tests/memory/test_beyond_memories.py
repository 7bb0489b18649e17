"""The memories beyond the paper: what each keeps, what it learns, and that an episode remembers
what a cache does.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from mme_vla import UserError
from mme_vla.data.sources import open_sources
from mme_vla.memory.base import stack_history
from mme_vla.memory.extensions.actions import LSTMLayer
from mme_vla.memory.extensions.gist import Gist
from mme_vla.memory.extensions.learned_topk import LearnedTopK
from mme_vla.memory.extensions.moment import Moment
from mme_vla.memory.extensions.retrieval import Retrieval, chunks_of
from mme_vla.memory.history import CachedHistory
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.base import motion_rows
from mme_vla.testing.small import (
    BEYOND,
    SMALL_VISION,
    cached_history,
    moving_frames,
    random_batch,
    small_policy,
)
from mme_vla.types import HistoryTokens, MemoryTokens

D = 24
FEW_TOKENS: dict[str, Any] = {"vision": {**SMALL_VISION, "patch_size": 8}}
"""8×8 tokens a view: nothing here depends on their number."""


def stored(memory: Any, tokens: torch.Tensor, exec_start: int = 0) -> CachedHistory:
    """The history of an episode of which every frame is told by tokens [t, p, D]."""
    frames = memory.storage.stored_frames(len(tokens))
    return CachedHistory(
        memory.storage, tokens[frames].numpy(), frames, len(tokens), None, exec_start
    )


def noise(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def encoded(
    memory: Any, tokens: torch.Tensor, step: int | None = None, exec_start: int = 0
) -> MemoryTokens:
    step = len(tokens) - 1 if step is None else step
    with torch.no_grad():
        memory_tokens: MemoryTokens = memory(
            stack_history([memory.gather_selection(stored(memory, tokens, exec_start), step)])
        )
    return memory_tokens


# Retrieval


def scene_sequence(order: str, stay: int) -> torch.Tensor:
    """An episode that stays `stay` frames in each of several places, whose tokens differ but for a
    little noise.
    """
    places = {name: noise(4, D, seed=ord(name)) for name in sorted(set(order))}
    features = torch.stack([places[name] for name in order for _ in range(stay)])
    return features + 0.05 * noise(*features.shape)


def test_retrieval_stores_where_it_was_before_and_drops_all_else() -> None:
    memory = Retrieval(D, 16, budget=4 * 10, grid=2, every=1, cut=0.8, longest=6)
    frames = sorted(
        set(memory.select(stored(memory, scene_sequence("ABCDEB", 6)), 35)[:, 0].tolist())
    )
    assert frames[-1] == 35 and len(frames) == 10
    assert set(range(6, 12)) <= set(frames), "the six frames in B"
    after_move = sorted(
        set(memory.select(stored(memory, scene_sequence("ABCDEC", 6)), 35)[:, 0].tolist())
    )
    assert set(range(12, 18)) <= set(after_move) and not set(range(6, 12)) <= set(after_move)


def test_retrieval_cuts_where_the_view_changes_where_the_video_ends_and_where_a_chunk_is_long() -> (
    None
):
    cuts, execution = np.zeros(11, bool), np.arange(12) >= 7
    cuts[2] = True
    lengths = [chunk.tolist() for chunk in chunks_of(cuts, execution, 4)]
    assert lengths == [[0, 1, 2], [3, 4, 5, 6], [7, 8, 9, 10], [11]]


def test_retrieval_reads_tokens_as_they_are_stored() -> None:
    """What a prompt does to tokens (`mark`) is not known when a dataset is read, so it must not
    decide.
    """
    policy = small_policy("retrieval_modul", memory={"budget": 64, "every": 2}, backbone=FEW_TOKENS)
    policy.backbone.condition_on_prompt = lambda tokens, prompt, prompt_mask: (
        -tokens * torch.arange(tokens.shape[-1])
    )  # type: ignore[method-assign]
    frames, histories = moving_frames(40), []
    select = policy.require_memory().select
    policy.require_memory().select = lambda *arguments: (
        histories.append(select(*arguments)) or histories[-1]
    )  # type: ignore[method-assign]
    episode = policy.start_episode("press the button")
    episode.observe({"front": frames, "wrist": frames}, np.zeros((40, 8), np.float32))
    policy.act([episode])
    assert np.array_equal(histories[-1], select(cached_history(policy, frames), 39))


# Moment


def test_a_moment_knows_what_was_before_it_and_nothing_that_came_later() -> None:
    memory = Moment(D, 16, budget=20, moments=2, grid=2, stride=1)
    tokens, changed = noise(10, 4, D), noise(10, 4, D)
    changed[5] += 3
    before, after = encoded(memory, tokens), encoded(memory, changed)
    same = (before.tokens - after.tokens).abs().amax((0, 2)).view(10, 2).amax(1) < 1e-6
    assert same.tolist() == [True] * 5 + [False] * 5
    assert before.ages is not None and before.ages[0].tolist() == [
        age for age in range(9, -1, -1) for _ in range(2)
    ]


# Gist


def test_gist_keeps_all_of_the_beginning_and_the_end_and_a_few_tokens_of_all_between() -> None:
    memory = Gist(D, 16, budget=(1 + 2) * 4 + 3 * 5, anchors=1, recent=2, gists=3, grid=2, stride=1)
    tokens = encoded(memory, noise(8, 4, D))
    assert tokens.ages is not None and tokens.mask.all()
    assert (
        tokens.ages[0].tolist()
        == [7.0] * 4
        + [6.0] * 3
        + [5.0] * 3
        + [4.0] * 3
        + [3.0] * 3
        + [2.0] * 3
        + [1.0] * 4
        + [0.0] * 4
    )
    long = memory.selected_frames(500, 200)
    assert len(long) == 8 and (long[0], long[-2], long[-1]) == (0, 499, 500)
    assert np.diff(long[1:-2]).min() > 80, (
        "more frames than there is room for are kept evenly spaced"
    )
    assert encoded(memory, noise(2, 4, D)).mask.sum() == 8, "a short episode is whole"


def test_an_older_frame_is_read_through_its_gist_alone_also_by_later_ones() -> None:
    memory = Gist(D, 16, budget=(1 + 1) * 4 + 3 * 3, anchors=1, recent=1, gists=3, grid=2, stride=1)
    tokens = noise(5, 4, D)
    changed = tokens.clone()
    changed[2] += 2  # anchors: 0; gists of 1, 2 and 3; recent: 4
    changed_rows = (encoded(memory, tokens).tokens - encoded(memory, changed).tokens).abs().amax(
        -1
    )[0] > 1e-6
    assert changed_rows.tolist() == [False] * 4 + [False] * 3 + [True] * 6 + [False] * 4


# Learned top-k


def test_learned_topk_finds_the_tokens_that_matter_from_the_loss_alone() -> None:
    """Of 32 candidates 4 bear a mark; the answer is the mean of what marked ones say, and 3 can be
    kept.
    """
    torch.manual_seed(0)
    memory = LearnedTopK(D, 1, budget=4, pool=8, grid=2, hidden=16, layers=1)
    generator, optimizer = (
        torch.Generator().manual_seed(1),
        torch.optim.Adam(memory.parameters(), lr=1e-2),
    )

    def batch() -> tuple[HistoryTokens, torch.Tensor, torch.Tensor]:
        features = torch.randn(16, 32, D, generator=generator)
        targets = torch.rand(16, 32, generator=generator).argsort(1) < 4
        values = torch.randn(16, generator=generator)
        features[..., 0] = 4.0 * targets
        features[..., 1] = torch.where(targets, values[:, None], features[..., 1])
        positions = torch.zeros(16, 32, 3)
        mask = torch.ones(16, 32, dtype=torch.bool)
        return HistoryTokens(features, positions, mask, torch.zeros(16)), values, targets

    def hit_rate() -> float:
        history, _, targets = batch()
        with torch.no_grad():
            indices, _ = memory.keep(memory.scores(history), history.mask)
        return float(targets.gather(1, indices).float().mean())

    before = hit_rate()
    for _ in range(220):
        history, values, _ = batch()
        loss = (memory(history).tokens[:, :3, 0].mean(1) - values).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert before < 0.5 and hit_rate() > 0.9


def test_learned_topk_keeps_time_and_tells_the_age_of_what_it_keeps() -> None:
    memory = LearnedTopK(D, 16, budget=9, pool=6, grid=2)
    tokens = encoded(memory, noise(6, 4, D))
    assert tokens.ages is not None
    ages = tokens.ages[0, :8].tolist()
    assert ages == sorted(ages, reverse=True) and tokens.mask.all()
    few = encoded(memory, noise(1, 4, D))
    assert few.mask[0].tolist() == [True] * 4 + [False] * 5, (
        "all that there is; nothing is left over"
    )


def test_what_is_not_stored_still_reaches_the_loss() -> None:
    memory = LearnedTopK(D, 16, budget=5, pool=6, grid=2)
    history = stack_history([memory.gather_selection(stored(memory, noise(6, 4, D)), 5)])
    history = replace(history, features=history.features.requires_grad_())
    indices, _ = memory.keep(memory.scores(history), history.mask)
    memory(history).tokens[:, -1].sum().backward()
    left = torch.ones(24, dtype=torch.bool).scatter(0, indices[0], False)
    assert (
        history.features.grad is not None
        and (history.features.grad[0, left].abs().sum(-1) > 0).all()
    )


# Actions


@cache
def mover(integration: str = "modul") -> MMEPolicy:
    return small_policy(
        f"actions_{integration}", memory={"max_steps": 12, "max_video": 6}, backbone=FEW_TOKENS
    )


def test_action_memory_reads_actions_and_no_image() -> None:
    policy = mover()
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(2, 33, 8)).astype(np.float32) * 0.3
    demo = np.arange(33) < 9

    def remembered(frames: np.ndarray, states: np.ndarray, actions: np.ndarray) -> torch.Tensor:
        episode = policy.start_episode("press the button")
        images = {"front": frames, "wrist": frames}
        episode.observe(images, states, demo, actions[9:])
        tokens = policy.require_memory().encode([episode.required_history()], [episode.stream])
        return tokens.tokens.detach()

    frames = moving_frames(33)
    base = remembered(frames, states, actions)
    assert torch.equal(base, remembered(255 - frames, states, actions))
    assert not torch.allclose(
        base, remembered(frames, states + (np.arange(33) == 8)[:, None], actions)
    )
    assert not torch.allclose(
        base, remembered(frames, states, actions + (np.arange(33) == 28)[:, None])
    )
    assert policy.frames_read(np.array([32]), 9).size == 0, "nothing has to be rendered for it"


def test_past_frames_without_states_are_refused() -> None:
    with pytest.raises(UserError, match="with their states"):
        mover().start_episode("press the button").add_frames(moving_frames(3))
    episode = mover().start_episode("press the button")
    episode.add_frames(moving_frames(3), states=np.zeros((3, 8), np.float32))
    assert episode.history is not None and len(episode.history) == 3


# All of them

SMALLER: dict[str, dict[str, Any]] = {
    "retrieval": {"budget": 64, "every": 4},
    "moment": {"budget": 32, "every": 16},
    "gist": {"budget": 160, "stride": 8, "every": 4},
    "actions": {"max_steps": 12, "max_video": 6},
    "learned_topk": {"budget": 48, "pool": 8, "every": 4},
    "spacetime": {"frames": 3, "stride": 5},
    "anchors": {"spacing": 5},
    "events": {"budget": 64, "stride": 4},
    "pyramid": {"budget": 128, "strides": [1, 4]},
    "keyframes": {"budget": 64, "every": 4, "pool": 8},
}


@pytest.fixture(params=BEYOND, scope="module")
def policy(request: pytest.FixtureRequest) -> MMEPolicy:
    words: dict[str, Any] = {"policy": {"history_dtype": "float32"}, "backbone": FEW_TOKENS}
    name: str = request.param
    return small_policy(name, memory=SMALLER[name.rsplit("_", 1)[0]], **words)


def test_an_episode_that_grows_acts_as_one_that_is_read_at_once(policy: MMEPolicy) -> None:
    frames = moving_frames(60)
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(2, 60, 8)).astype(np.float32) * 0.3
    demo, chunks = np.arange(60) < 20, []
    for piece in (60, 16, 7):
        episode = policy.start_episode("press the button", seed=3)
        for start in range(0, 60, piece):
            part = slice(start, min(start + piece, 60))
            view, executed = (
                {"front": frames[part], "wrist": frames[part]},
                actions[part][~demo[part]],
            )
            episode.observe(view, states[part], demo[part], executed)
            if not demo[part].any():
                # what the memory carries along is asked on the way, and again at the end
                policy.encode_memories([episode])
        chunks.append(policy.act([episode]))
    assert np.abs(chunks[0] - chunks[1]).max() < 1e-4 and np.abs(chunks[0] - chunks[2]).max() < 1e-4


def test_memory_compiles_in_one_piece(policy: MMEPolicy) -> None:
    batch, memory = random_batch(policy, valid=64), policy.require_memory()
    assert batch.history is not None
    torch._dynamo.reset()
    compiled = torch.compile(memory, fullgraph=True, backend="eager")
    with torch.no_grad():
        assert torch.allclose(
            compiled(batch.history).tokens, memory(batch.history).tokens, atol=1e-6
        )


def test_in_bfloat16_it_computes_what_it_computes_in_float32(policy: MMEPolicy) -> None:
    batch, draws = (
        random_batch(policy, valid=64),
        policy.training_noise(2, torch.Generator().manual_seed(0)),
    )
    with torch.no_grad():
        exact = float(policy(batch, draws)[0])
        policy.compute_dtype = torch.bfloat16
        rounded = float(policy(batch, draws)[0])
        policy.compute_dtype = torch.float32
    assert rounded != exact and abs(rounded - exact) < 0.02 * exact


def test_an_episode_feels_and_does_what_a_dataset_says_it_did() -> None:
    policy, source = mover(), open_sources(["sample"])[0]
    start, length = (
        int(source.exec_starts[0]),
        min(int(source.lengths[0]), int(source.exec_starts[0]) + 20),
    )
    frames = np.arange(length)
    recorded = motion_rows(policy.require_processor(), *source.robot_motion(0, frames))
    episode = policy.start_episode("press the button")
    states, actions = source.states(0, 0, length), source.actions(0, 0, length)
    for part in (slice(0, start + 1), slice(start + 1, start + 8), slice(start + 8, length)):
        images = np.zeros((len(frames[part]), 64, 64, 3), np.uint8)
        executed = actions[part.start - 1 : part.stop - 1] if part.start else None
        episode.observe(
            {"front": images, "wrist": images}, states[part], frames[part] < start, executed
        )
    assert torch.equal(torch.stack(episode._motion_of_frames), recorded)
    assert recorded[:, -1].tolist() == [0.0] * (start + 1) + [1.0] * (length - start - 1)


def test_what_the_robot_did_is_no_vision_token_and_is_not_highlighted_beside_a_prompt() -> None:
    """An episode's is not either: the memory has to be told the same in training."""
    actions = {"max_steps": 32, "max_video": 8}
    members: list[Any] = [{"name": "framesamp", "budget": 64}, {"name": "actions", **actions}]
    for name, memory in (("actions_modul", actions), ("framesamp_ttt_modul", {"members": members})):
        policy = small_policy(name, memory=memory, backbone=FEW_TOKENS)
        policy.backbone.condition_on_prompt = lambda tokens, prompt, prompt_mask: -tokens  # type: ignore[method-assign]
        batch = random_batch(policy, valid=96)
        assert batch.history is not None
        history = policy.require_memory().condition_on_prompt(
            batch.history, policy.model.prompt_condition(batch)
        )
        # The actions' rows come first, for they are padded on the left.
        features, n_local = (
            batch.history.features,
            batch.history.mask.shape[1] - (64 if "members" in memory else 0),
        )
        assert features[:, :n_local].abs().sum() > 0 and torch.equal(
            history.features[:, :n_local], features[:, :n_local]
        )
        assert torch.equal(history.features[:, n_local:], -features[:, n_local:])


@torch.no_grad()
def test_a_fresh_memory_of_actions_still_knows_the_beginning_at_the_end_of_its_window() -> None:
    layer = LSTMLayer(32, 2, 4, longest=256)
    rows, valid = noise(2, 256, 1, 32), torch.ones(2, 256, dtype=torch.bool)
    other = torch.cat([noise(2, 5, 1, 32, seed=1), rows[:, 5:]], 1)
    end, otherwise = (
        layer.read(layer.advance(layer.initial(2), x, valid)[0])[0] for x in (rows, other)
    )
    assert float((end - otherwise).norm() / end.norm()) > 0.05
