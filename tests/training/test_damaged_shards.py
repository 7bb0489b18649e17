"""Shards of a sharded run that are damaged, unchecked or elsewhere: the library's error names the
file.
"""

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.distributed import checkpoint as dcp

from mme_vla.errors import UserError
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import small_policy
from mme_vla.training.shards import RAW, SHARDS, read_weights, shard_files, shard_notes
from mme_vla.utils import sum_line, write_sums


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return small_policy("pi05")


@pytest.fixture(scope="module")
def saved(policy: MMEPolicy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a checkpoint with one shard, as a process of a sharded run writes it."""
    folder = tmp_path_factory.mktemp("checkpoint")
    tensors = {f"{RAW}/{name}": tensor for name, tensor in policy.state_dict().items()}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        writer = dcp.HuggingFaceStorageWriter(str(folder / SHARDS), save_distributed=True)
        dcp.save(tensors, storage_writer=writer, no_dist=True)
    add_sums(folder)
    return folder


@pytest.fixture
def checkpoint(saved: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(saved, tmp_path / "step_000001"))


def add_sums(checkpoint: Path) -> None:
    (file,) = shard_files(checkpoint)
    file.with_suffix(".sha256").write_text(sum_line(file, file.name))


def test_shards_with_their_checksums_are_read(policy: MMEPolicy, checkpoint: Path) -> None:
    weights = read_weights(checkpoint, policy)
    assert all(torch.equal(weights[name], tensor) for name, tensor in policy.state_dict().items())


def test_a_shard_without_its_checksum_is_refused(policy: MMEPolicy, checkpoint: Path) -> None:
    (file,) = shard_files(checkpoint)
    note = file.with_suffix(".sha256")
    note.write_text(note.read_text().replace(file.name, "another"))
    with pytest.raises(UserError, match=f"with the checksum of {file.name} is missing"):
        read_weights(checkpoint, policy)
    note.unlink()
    with pytest.raises(UserError, match=f"with the checksum of {file.name} is missing"):
        read_weights(checkpoint, policy)


def add_shard(checkpoint: Path) -> Path:
    (file,) = shard_files(checkpoint)
    added = file.with_name("shard-00002-model-00001-of-00001.safetensors")
    shutil.copy(file, added)
    added.with_suffix(".sha256").write_text(sum_line(added, added.name))
    return added


def test_a_shard_that_was_added_is_refused(policy: MMEPolicy, checkpoint: Path) -> None:
    (checkpoint / "config.json").write_text("{}")
    write_sums(checkpoint, ["config.json", *shard_notes(checkpoint)])
    read_weights(checkpoint, policy)
    added = add_shard(checkpoint)
    with pytest.raises(UserError, match=rf"SHA256SUMS does not list shards/{added.stem}\.sha256"):
        read_weights(checkpoint, policy)


def test_a_shard_that_was_replaced_with_its_checksum_is_refused(
    policy: MMEPolicy, checkpoint: Path
) -> None:
    write_sums(checkpoint, shard_notes(checkpoint))
    (file,) = shard_files(checkpoint)
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    add_sums(checkpoint)
    with pytest.raises(UserError, match=r"\.sha256 is damaged"):
        read_weights(checkpoint, policy)


def test_shards_whose_checksums_an_earlier_version_did_not_list_are_read(
    policy: MMEPolicy, checkpoint: Path
) -> None:
    (checkpoint / "config.json").write_text("{}")
    write_sums(checkpoint, ["config.json"])
    read_weights(checkpoint, policy)


def test_damage_is_an_error_of_the_library_whatever_the_checksum_says(
    policy: MMEPolicy, checkpoint: Path
) -> None:
    (file,) = shard_files(checkpoint)
    content, rng = file.read_bytes(), np.random.default_rng(0)
    header = 8 + int.from_bytes(content[:8], "little")
    refused = 0
    for case in range(60):
        damaged = bytearray(content)
        if case % 3 == 0:
            del damaged[int(rng.integers(len(damaged))) :]
        else:
            place = int(rng.integers(header if case % 3 == 1 else len(damaged)))
            damaged[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        for known in (False, True):
            if known:
                add_sums(checkpoint)
            try:
                read_weights(checkpoint, policy)
            except UserError:
                refused += 1
            else:
                assert known, "a checksum of other bytes"
        add_sums(checkpoint)
        file.write_bytes(content)
        add_sums(checkpoint)
    # a flipped bit of a weight that has a checksum of its own is another weight
    assert refused > 80


@pytest.mark.parametrize("name", ["shard", "checksum", "folder"])
def test_links_out_of_the_checkpoint_are_not_followed(
    policy: MMEPolicy, checkpoint: Path, name: str
) -> None:
    (file,) = shard_files(checkpoint)
    place = {"shard": file, "checksum": file.with_suffix(".sha256"), "folder": file.parent}[name]
    place.rename(checkpoint.parent / place.name)
    place.symlink_to(checkpoint.parent / place.name)
    with pytest.raises(UserError, match="lies outside of it"):
        read_weights(checkpoint, policy)
