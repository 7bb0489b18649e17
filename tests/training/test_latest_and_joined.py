"""`latest` is understood wherever weights are opened, and joined memories read their options."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from mme_vla import MMEPolicy, UserError, load_weights
from mme_vla.cli.weights import convert
from mme_vla.config.composition import compose
from mme_vla.testing.small import small_policy
from mme_vla.weights import transfer
from mme_vla.weights.released import to_released
from mme_vla.weights.source import open_source


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """A folder of runs, of which one has a checkpoint."""
    step = tmp_path / "runs" / "first" / "checkpoints" / "step_000002"
    small_policy("framesamp_modul").save_pretrained(step)
    (step / "training_state.json").write_text("{}")
    return tmp_path / "runs"


def test_a_run_and_latest_stand_for_their_newest_checkpoint(runs: Path, tmp_path: Path) -> None:
    state = MMEPolicy.from_pretrained(runs / "first" / "checkpoints" / "step_000002").state_dict()
    for place in (runs / "latest", runs / "first", runs / "first" / "checkpoints"):
        assert open_source(place).folder.name == "step_000002", place
    loaded = MMEPolicy.from_pretrained(str(runs / "latest"))
    assert all(torch.equal(value, state[name]) for name, value in loaded.state_dict().items())
    convert(runs / "latest", tmp_path / "converted")
    again = MMEPolicy.from_pretrained(tmp_path / "converted")
    assert all(torch.equal(value, state[name]) for name, value in again.state_dict().items())


def test_latest_of_nothing_is_no_checkpoint_and_no_repository(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"No run with a checkpoint in .*there is no .*latest"):
        MMEPolicy.from_pretrained(tmp_path / "latest")
    with pytest.raises(UserError, match="No run with a checkpoint in owner"):
        open_source("owner/latest")


def test_a_list_of_memories_in_a_file_says_where_its_keys_are(tmp_path: Path) -> None:
    (tmp_path / "model").mkdir()
    head = "# @package _global_\ndefaults:\n  - /integration: modulator\n"
    (tmp_path / "model" / "both.yaml").write_text(head + "name: both\nmemory: [framesamp, ttt]\n")
    keyed = "  - /memory: joined\nname: keyed\nmemory: {members: [framesamp, ttt]}\n"
    (tmp_path / "model" / "keyed.yaml").write_text(head + keyed)
    single = compose("policy", ["model=both"], extra_dirs=[tmp_path]).memory
    assert single == compose("policy", ["model=keyed"], extra_dirs=[tmp_path]).memory
    with pytest.raises(
        UserError,
        match=r"'memory.budget=256'.*list \['framesamp', 'ttt'\].*`/memory: joined`.*memory=\[",
    ):
        compose("policy", ["model=both", "memory.budget=256"], extra_dirs=[tmp_path])
    for words in (["model=keyed"], ["model=framesamp_ttt_modul"], ["memory=[framesamp,ttt]"]):
        assert (
            compose("policy", [*words, "memory.budget=256"], extra_dirs=[tmp_path]).memory.budget
            == 256
        ), words


@pytest.mark.parametrize("released", ["ttt_modul", "framesamp_modul"])
def test_a_joined_memory_starts_anew_beside_a_released_network(
    released: str, tmp_path: Path
) -> None:
    alone = small_policy(released, seed=1)
    save_file(
        {k: v.contiguous() for k, v in to_released(alone).items()}, tmp_path / "model.safetensors"
    )
    joined = small_policy("framesamp_ttt_modul", seed=2)
    before = {name: value.clone() for name, value in joined.state_dict().items()}
    start = transfer(joined, tmp_path)
    after, network = joined.state_dict(), alone.state_dict()
    members = [name for name in after if name.startswith("memory.members.")]
    assert start.new == sorted(members) and set(start.taken) == set(after) - set(members)
    assert all(torch.equal(after[name], before[name]) for name in members)
    assert all(torch.equal(after[name], network[name]) for name in start.taken)
    assert start.left and all("mem_" in name for name in start.left)
    with pytest.raises(UserError, match=r"JoinedMemory .*start_from\(\)"):
        load_weights(joined, tmp_path)
