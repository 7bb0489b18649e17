"""Orbax checkpoints read and written without JAX. `data/make_orbax.py` made the ones here with
Orbax itself.
"""

import hashlib
import json
import os
import shutil
from pathlib import Path

import pytest
import torch

from helpers import golden
from mme_vla import UserError
from mme_vla.testing.small import small_policy
from mme_vla.weights import load_weights, open_source, read_stats
from mme_vla.weights.orbax import read_orbax, write_orbax

pytest.importorskip("tensorstore", reason="reading Orbax checkpoints needs the extra 'orbax'")

DATA = Path(__file__).resolve().parents[1] / "data"
RUN, BASELINE = DATA / "orbax_run", DATA / "orbax_plain"
CASE = "model_perceptual-tokendrop-modul"


def checksum(name: str, tensor: torch.Tensor) -> str:
    array = tensor.numpy()
    return hashlib.sha256(f"{name}{array.shape}".encode() + array.tobytes()).hexdigest()


def test_every_leaf_is_what_orbax_wrote() -> None:
    tree = read_orbax(RUN / "100" / "params")
    assert {name: checksum(name, leaf) for name, leaf in tree.items()} == json.loads(
        (DATA / "orbax_run.json").read_text()
    )


def test_unboxed_layout_reads_with_and_without_outer_names() -> None:
    tree = read_orbax(BASELINE)
    assert set(tree) == {"PaliGemma/img/embedding/bias", "time_mlp_in/kernel", "scale"}
    assert tree["PaliGemma/img/embedding/bias"].tolist() == [0, 1, 2, 3, 4, 5]
    assert tree["time_mlp_in/kernel"].dtype == torch.bfloat16
    assert tree["time_mlp_in/kernel"].float().tolist() == [[0, 0.25, 0.5], [0.75, 1, 1.25]]
    assert tree["scale"].shape == ()


@pytest.mark.timeout(60)
def test_a_pipe_in_the_place_of_a_part_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    folder = tmp_path / "params"
    shutil.copytree(RUN / "100" / "params", folder)
    part = max(
        (file for file in folder.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size
    )
    part.unlink()
    os.mkfifo(part)
    with pytest.raises(UserError, match=f"{part.name} is not a file"):
        read_orbax(folder)


@pytest.mark.parametrize("place", [RUN, RUN / "100", RUN / "100" / "params"])
def test_run_step_and_arrays_are_the_same_source(place: Path) -> None:
    source = open_source(place)
    assert open_source(place).format == "released"
    assert source.params == RUN / "100" / "params"
    assert source.variants == ["tokendrop_modul"]
    stats = read_stats(source.folder)
    assert stats is not None
    assert stats.actions.q99[1] == 1.5


@torch.no_grad()
def test_a_checkpoint_of_orbax_reproduces_the_golden_outputs(parity: Path) -> None:
    tensors, about = golden.load(parity, CASE)
    policy = golden.policy(tensors, about)
    for parameter in policy.parameters():
        parameter.zero_()
    load_weights(policy, RUN)
    batch, memory = golden.batch(tensors), golden.memory_tokens(policy, tensors)
    velocity = policy.predict(batch, tensors["out/x_t"], tensors["in/time"], memory)
    assert golden.error(velocity, tensors["out/v_t"]) < 1e-4
    chunk = policy.sample_actions(batch, tensors["in/sample_noise"], memory=memory)
    assert golden.error(chunk, tensors["out/sampled_actions"]) < 1e-4


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.complex64, torch.int32])
def test_what_is_saved_reads_back(dtype: torch.dtype, tmp_path: Path) -> None:
    tree = {"a/b": torch.arange(6).reshape(2, 3).to(dtype), "c": torch.tensor(3).to(dtype)}
    write_orbax(tree, tmp_path / "params")
    back = read_orbax(tmp_path / "params")
    assert set(back) == set(tree)
    assert all(
        torch.equal(back[name], leaf) and back[name].dtype == dtype for name, leaf in tree.items()
    )


def test_an_error_of_the_check_of_shapes_is_not_one_of_the_file(tmp_path: Path) -> None:
    write_orbax({"a": torch.zeros(2)}, tmp_path / "params")
    with pytest.raises(KeyError, match="absent"):
        read_orbax(tmp_path / "params", fits=lambda shapes: shapes["absent"])


def test_a_checkpoint_without_its_values_is_refused(tmp_path: Path) -> None:
    shutil.copytree(RUN, tmp_path / "run")
    largest = max((tmp_path / "run").glob("**/d/*"), key=lambda file: file.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:1000])
    with pytest.raises(UserError, match="damaged: it cannot be read as an Orbax checkpoint"):
        open_source(tmp_path / "run").tensors()


def test_all_leaves_that_do_not_fit_are_listed_together(tmp_path: Path) -> None:
    policy = small_policy("framesamp_modul")
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    with pytest.raises(
        UserError, match=r"(?s)orbax_plain.*missing.*unexpected:\s+scale.*2 misshapen"
    ):
        load_weights(policy, BASELINE)
    assert all(torch.equal(tensor, before[name]) for name, tensor in policy.state_dict().items())
