"""Several memories under one budget: each as if it were alone, in every place where a memory
stands.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.cli import inspect
from mme_vla.config.composition import compose
from mme_vla.memory.base import stack_history
from mme_vla.memory.history import PromptConditionedHistory
from mme_vla.memory.joined import JoinedMemory, finer
from mme_vla.registry import MEMORIES
from mme_vla.testing import check_memory
from mme_vla.testing.check_memory import D_VISION, WIDTH, Episode
from mme_vla.testing.small import moving_frames, random_batch, small_policy
from mme_vla.types import HistoryTokens

TTT = {"name": "ttt", "max_steps": 8, "max_video": 4, "budget": 16}
RMT = {"name": "rmt", "max_steps": 8, "max_video": 4, "budget": 16}
FRAMES = {"name": "framesamp", "budget": 64}
COMPOSITIONS = {
    "other grids": [FRAMES, TTT],
    "a scorer of a coarser grid": [
        {"name": "tokendrop", "grid": 4, "budget": 64},
        {**FRAMES, "grid": 8},
    ],
    "two recurrent ones": [TTT, {"name": "tokendrop", "budget": 128}, RMT],
}


def joined(members: list[Any], budget: int = 512) -> JoinedMemory:
    torch.manual_seed(0)
    memory: JoinedMemory = MEMORIES.build(
        {"name": "joined", "members": members, "budget": budget}, d_vision=D_VISION, width=WIDTH
    )
    return memory


def alone(memory: JoinedMemory, i: int, episode: Episode) -> Episode:
    """The episode as member `i` would have stored it by itself: pooled once, to its own grid."""
    member = memory.memories[i]
    recordings = Episode(member, episode.length)
    times = memory.storage.grid // member.storage.grid
    cells = finer(
        np.array([[0, p] for p in range(member.storage.grid**2)]),
        member.storage.grid,
        memory.storage.grid,
    )
    recordings.tokens = episode.tokens[:, cells[:, 1]].unflatten(1, (-1, times**2)).mean(2)
    return recordings


@pytest.mark.parametrize("members", COMPOSITIONS.values(), ids=COMPOSITIONS)
def test_a_joined_memory_keeps_a_memorys_contract(members: list[Any]) -> None:
    check_memory("joined", members=members)


@pytest.mark.parametrize("members", COMPOSITIONS.values(), ids=COMPOSITIONS)
@torch.no_grad()
def test_every_member_replies_as_when_alone(members: list[Any]) -> None:
    memory = joined(members).eval()
    episode, steps = Episode(memory, 48), (3, 20, 47)
    tokens = memory(
        stack_history([memory.gather_selection(episode.cached(), step) for step in steps])
    )
    start = 0
    for i, member in enumerate(memory.memories):
        history = alone(memory, i, episode).cached()
        expected = member(stack_history([member.gather_selection(history, step) for step in steps]))
        part = slice(start, start + member.budget)
        assert torch.equal(tokens.mask[:, part], expected.mask)
        error = (tokens.tokens[:, part] - expected.tokens)[expected.mask].abs().max()
        assert error < 1e-5
        start += member.budget
    assert start == memory.budget == tokens.tokens.shape[1] <= 512


def test_a_member_finds_the_frames_that_it_keeps_however_many_the_others_do() -> None:
    """`history.stored_frames` is that of the member alone, also where others keep every frame."""
    memory = joined([{**FRAMES, "every": 4}, TTT])
    sparse, dense = memory.memories
    assert memory.storage.keep_every == 1
    history = Episode(memory, 20).cached()
    stored: dict[Any, list[int]] = {}
    for member in memory.memories:

        def note(view: Any, step: int, rng: Any = None, member: Any = member) -> np.ndarray:
            stored[member] = view.stored_frames.tolist()
            return np.array([[0, 0]])

        member.select = note  # type: ignore[assignment, method-assign]
    memory.gather_selection(history, 19)
    assert stored[sparse] == [0, 3, 7, 11, 15, 19]
    assert stored[dense] == list(range(20))


@torch.no_grad()
def test_the_prompt_conditions_the_same_tokens_in_training_and_in_an_episode() -> None:
    """A member of a coarser grid reads pooled tokens, and the prompt changes these."""
    memory = joined([FRAMES, {**FRAMES, "grid": 8}]).eval()
    episode = Episode(memory, 20)
    selection = stack_history([memory.gather_selection(episode.cached(), 19)])
    trained = memory(memory.condition_on_prompt(selection, torch.relu))
    history = PromptConditionedHistory(episode.cached(), torch.relu)
    met = memory.encode([history], [memory.start_stream()])
    assert torch.equal(met.mask, trained.mask)
    assert torch.equal(met.tokens[met.mask], trained.tokens[trained.mask])


@torch.no_grad()
def test_the_prompt_conditions_tokens_beside_states_as_in_an_episode() -> None:
    """States are float32, so a selection of both is, and tokens of an episode are bfloat16."""
    memory = joined([FRAMES, "actions"]).eval()
    episode = Episode(memory, 20, dtype=torch.bfloat16)

    def with_prompt(tokens: torch.Tensor) -> torch.Tensor:
        return tokens * torch.tensor(1.2345).to(tokens.dtype)

    selection = stack_history([memory.gather_selection(episode.cached(), 19)])
    trained = memory(memory.condition_on_prompt(selection, with_prompt))
    history = PromptConditionedHistory(episode.cached(), with_prompt)
    met = memory.encode([history], [memory.start_stream()])
    assert torch.allclose(met.tokens[met.mask], trained.tokens[trained.mask], atol=1e-6)


def test_budgets_are_shared_evenly_or_as_configured() -> None:
    assert [m.budget for m in joined(["framesamp", "ttt"]).memories] == [256, 256]
    assert [m.budget for m in joined(["framesamp", "ttt", "rmt"]).memories] == [160, 160, 160]
    assert [m.budget for m in joined([{**FRAMES, "budget": 128}, "ttt"], 256).memories] == [
        128,
        128,
    ]
    assert [m.budget for m in joined(["framesamp", {"name": "present", "grid": 2}]).memories] == [
        256,
        4,
    ]


def test_members_that_store_nothing_ask_nothing_of_the_storage() -> None:
    stored = joined(
        [{**FRAMES, "grid": 2, "every": 3, "pooling": "max"}, {"name": "actions", "budget": 16}]
    ).storage
    assert (stored.grid, stored.pooling, stored.keep_every) == (2, "max", 3)


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ([FRAMES, {**TTT, "budget": 500}], "framesamp 64, ttt 500"),
        ([{**FRAMES, "budget": 512}, "ttt"], "ttt an even share"),
        (["framesamp"], "at least two"),
        (["framesamp", 3], "no memory to join"),
        ([{**FRAMES, "budget": []}, TTT], r"budget=\[\] must be a whole number"),
        ([{**FRAMES, "budget": 7.5}, TTT], r"budget=7\.5 must be a whole number"),
        (
            [FRAMES, {**TTT, "pooling": "max"}],
            r"(?s)framesamp stores.*mean.*ttt.*max.*Set the same pooling",
        ),
        (["tokendrop", {"name": "tokendrop", "stride": 4}], "the same grid and stride"),
        (["framesamp", "tttt"], "ttt"),
        ([{**FRAMES, "every": 7.5}, TTT], r"memory\.every=7\.5 must be at least 1"),
        ([{**FRAMES, "grid": 0}, TTT], "memory.grid=0 must be at least 1"),
    ],
)
def test_what_cannot_be_joined_is_reported(members: list[Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        joined(members)


def test_equal_names_are_distinguished_in_what_is_reported() -> None:
    memory = joined([TTT, {**TTT, "stride": 4}])
    memory.reporting = True
    episode = Episode(memory, 40)
    metrics = memory(stack_history([memory.gather_selection(episode.cached(), 39)])).metrics
    assert {name.split("/")[0] for name in metrics} == {"ttt", "ttt_2"}
    memory.reporting = False
    assert memory(stack_history([memory.gather_selection(episode.cached(), 39)])).metrics == {}


def test_every_member_learns_through_an_integration() -> None:
    policy = small_policy("pi05", memory=[FRAMES, TTT], integration="expert")
    batch = random_batch(policy, 1)
    assert batch.history is not None
    batch.history = HistoryTokens(
        batch.history.features, batch.history.positions, torch.ones_like(batch.history.mask)
    )
    before, _ = policy(batch, policy.training_noise(1, torch.Generator().manual_seed(0)))
    before.backward()
    assert isinstance(policy.memory, JoinedMemory)
    for member in policy.memory.memories:
        gradient = member.get_parameter("encoder.project.weight").grad
        assert gradient is not None
        assert gradient.abs().sum() > 0
    torch.optim.SGD(policy.parameters(), 1e-3).step()
    after, _ = policy(batch, policy.training_noise(1, torch.Generator().manual_seed(0)))
    assert after < before


@torch.no_grad()
def test_a_running_episode_acts_as_a_fresh_start_and_a_saved_policy_as_the_first(
    tmp_path: Path,
) -> None:
    policy = small_policy("framesamp_ttt_modul", memory={"members": [FRAMES, TTT]})
    policy.save_pretrained(tmp_path)
    again = MMEPolicy.from_pretrained(tmp_path)
    assert again.config["memory"] == {"name": "joined", "budget": 512, "members": [FRAMES, TTT]}
    frames = moving_frames(33, size=64)

    def chunks(which: MMEPolicy, pieces: list[slice]) -> np.ndarray:
        episode = which.start_episode("press the button", seed=1)
        for piece in pieces:
            frames_ = frames[piece]
            episode.observe(
                {"front": frames_, "wrist": frames_}, np.zeros((len(frames_), 8), np.float32)
            )
            which.encode_memories([episode])
        return which.act(episode)

    streamed = chunks(policy, [slice(0, 1), slice(1, 17), slice(17, 33)])
    assert np.abs(streamed - chunks(policy, [slice(0, 33)])).max() < 1e-4
    assert np.array_equal(streamed, chunks(again, [slice(0, 1), slice(1, 17), slice(17, 33)]))


def test_a_list_of_memories_is_understood_everywhere(tmp_path: Path) -> None:
    composed = compose("train", ["memory=[framesamp,ttt]", "integration=modulator"])
    assert composed.memory.members == ["framesamp", "ttt"]
    several = build_policy("pi05", memory=["tokendrop", "rmt"], integration="expert", device="meta")
    assert isinstance(several.memory, JoinedMemory)
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "two.yaml").write_text(
        "# @package _global_\ndefaults:\n  - /integration: context\nname: two\n"
        "memory: [{name: framesamp, budget: 128}, {name: ttt, budget: 256}]\n"
    )
    policy = build_policy("two", config_dir=tmp_path, device="meta")
    assert policy.config["name"] == "two"
    assert isinstance(policy.memory, JoinedMemory)
    assert [member.budget for member in policy.memory.memories] == [128, 256]


@pytest.mark.slow
def test_inspect_draws_what_all_members_store(tmp_path: Path) -> None:
    inspect.main(
        compose(
            "inspect",
            [
                "dataset=sample",
                "memory=[framesamp,ttt]",
                "episode=0",
                "step=40",
                f"output={tmp_path}",
            ],
        )
    )
    assert [path.name.rpartition("_")[2] for path in tmp_path.iterdir()] == ["joined.png"]
