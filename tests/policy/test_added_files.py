"""Files that are added to a checkpoint: what is read is what was checked, or is refused by
name.
"""

import json
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from mme_vla import MMEPolicy, UserError
from mme_vla.extras.methods.diffusion_policy.weights import read_diffusion_stats
from mme_vla.extras.methods.openvla_oft.weights import merged, read_dataset_statistics, with_heads
from mme_vla.policy.tensor_files import (
    INDEX,
    WEIGHTS,
    check_transformers_folder,
    list_weight_files,
    load_tensors,
    save_tensors,
)
from mme_vla.testing.small import SMALL_VISION, small_policy
from mme_vla.training.checkpoint import read_state, restore, save_checkpoint, trainable
from mme_vla.training.optim import EMA
from mme_vla.training.settings import KeepRule
from mme_vla.utils import SUMS, Sums, check_sums, checked_file, write_sums
from mme_vla.weights import load_weights, start_from
from mme_vla.weights.source import Source
from mme_vla.weights.statistics import read_stats

Read = Callable[[Path], Any]


def tiny() -> MMEPolicy:
    return small_policy("pi05", backbone={"depth": 1, "vision": {**SMALL_VISION, "patch_size": 16}})


def training(policy: MMEPolicy) -> tuple[MMEPolicy, EMA, torch.optim.Optimizer]:
    parameters = trainable(policy)
    return policy, EMA(parameters, 0.9), torch.optim.AdamW(parameters.values(), 1e-3)


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    return save_checkpoint(folder, 1, *training(tiny()), {"train": {"steps": 1}}, KeepRule())


@pytest.fixture
def checkpoint(intact: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(intact, tmp_path / intact.name))


def resume(folder: Path) -> None:
    read_state(folder)
    restore(folder, *training(tiny()))


READERS: dict[str, Read] = {
    "policy": MMEPolicy.from_pretrained,
    "resume": resume,
    "conversion": lambda folder: load_weights(tiny(), folder),
    "init_from": lambda folder: start_from(tiny(), folder),
}


def halved(folder: Path) -> None:
    """Add other weights and an index that names them."""
    tensors = {name: tensor * 0.5 for name, tensor in load_file(folder / WEIGHTS).items()}
    save_file(tensors, folder / "evil.safetensors")
    (folder / INDEX).write_text(
        json.dumps({"weight_map": dict.fromkeys(tensors, "evil.safetensors")})
    )


def unlist(folder: Path, name: str) -> None:
    lines = (folder / SUMS).read_text().splitlines(keepends=True)
    (folder / SUMS).write_text("".join(line for line in lines if not line.endswith(f"  {name}\n")))


def refusal(read: Read, folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        read(folder)
    assert len(str(caught.value)) <= 2000
    return str(caught.value)


@pytest.mark.parametrize("listed", ["listed", "not listed", "no sums"])
@pytest.mark.parametrize("reader", READERS)
def test_weights_and_an_index_of_others_are_refused_by_every_reader(
    reader: str, listed: str, checkpoint: Path
) -> None:
    halved(checkpoint)
    if listed == "listed":
        write_sums(checkpoint, [INDEX, "evil.safetensors"], keep=True)
    if listed == "no sums":
        (checkpoint / SUMS).unlink()
    reason = f"does not list {INDEX}" if listed == "not listed" else f"both {WEIGHTS} and {INDEX}"
    assert reason in refusal(READERS[reader], checkpoint)


@pytest.mark.parametrize("reader", READERS)
def test_an_added_index_in_place_of_the_weights_is_refused(reader: str, checkpoint: Path) -> None:
    halved(checkpoint)
    (checkpoint / WEIGHTS).unlink()
    assert f"does not list {INDEX}" in refusal(READERS[reader], checkpoint)


def test_a_shard_that_is_not_listed_is_refused_though_its_index_is(tmp_path: Path) -> None:
    save_tensors({"a": torch.ones(300), "b": torch.ones(300)}, tmp_path, max_shard_size="1KB")
    write_sums(tmp_path)
    assert set(load_tensors(tmp_path)) == {"a", "b"}
    shard = list_weight_files(tmp_path)[-1]
    unlist(tmp_path, shard)
    assert f"does not list {shard}" in refusal(load_tensors, tmp_path)


@pytest.mark.parametrize(
    ("name", "reader"),
    [
        *(
            (name, "policy")
            for name in (
                "config.json",
                "processor.json",
                "norm_stats.json",
                "tokenizer.model",
                WEIGHTS,
            )
        ),
        *(
            (name, "resume")
            for name in ("raw.safetensors", "optimizer.safetensors", "training_state.json")
        ),
        ("config.json", "conversion"),
        (WEIGHTS, "init_from"),
    ],
)
def test_every_file_that_is_read_must_be_listed(name: str, reader: str, checkpoint: Path) -> None:
    READERS[reader](checkpoint)
    unlist(checkpoint, name)
    assert f"does not list {name}" in refusal(READERS[reader], checkpoint)


def test_notes_and_cards_may_be_added(checkpoint: Path) -> None:
    for name in ("notes.txt", "README.md", "other.safetensors"):
        (checkpoint / name).write_text("mine")
    for read in READERS.values():
        read(checkpoint)


def test_the_line_that_the_message_names_lets_a_file_in(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    write_sums(tmp_path)
    (tmp_path / "stats.json").write_bytes(b"abc")
    assert "sha256sum" in refusal(lambda folder: checked_file(folder, "stats.json"), tmp_path)
    with (tmp_path / SUMS).open("a") as file:  # as `sha256sum ./stats.json` writes it
        file.write(
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad  ./stats.json\n"
        )
    assert checked_file(tmp_path, "stats.json") == tmp_path / "stats.json"
    check_sums(tmp_path, [*Sums(tmp_path).table])


def test_the_weights_that_are_read_are_listed_relative_to_the_folder(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    save_file({"a": torch.ones(1)}, tmp_path / "parts" / "one.safetensors")
    (tmp_path / INDEX).write_text(json.dumps({"weight_map": {"a": "parts/one.safetensors"}}))
    (tmp_path / "left.safetensors").write_bytes(b"not read")
    assert list_weight_files(tmp_path) == [INDEX, "parts/one.safetensors"]


@pytest.mark.parametrize(
    ("name", "read"),
    [
        (
            "model.pth",
            lambda folder: Source("diffusion_policy", folder, (folder / "model.pth",)).tensors(),
        ),
        ("stats.json", read_diffusion_stats),
        ("dataset_statistics.json", read_dataset_statistics),
        ("action_head--5_checkpoint.pt", lambda folder: with_heads({}, folder)),
        ("lora_adapter/adapter_config.json", lambda folder: merged({}, folder)),
        (
            "params/array/.zarray",
            lambda folder: Source("released", folder, params=folder / "params").tensors(),
        ),
        ("step.zip", lambda folder: load_weights(tiny(), folder / "step.zip")),
        ("norm_stats.json", read_stats),
        ("policy_preprocessor.json", read_stats),
    ],
)
def test_formats_of_others_are_held_to_the_sums_as_well(
    name: str, read: Read, tmp_path: Path
) -> None:
    (tmp_path / "listed").write_text("was there")
    write_sums(tmp_path)
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    if name.endswith(".zip"):
        zipped = zipfile.ZipFile(tmp_path / name, "w")
        zipped.writestr("params/manifest.ocdbt", b"x")
        zipped.close()
    elif name.endswith((".pt", ".pth")):
        torch.save({"model": {"a": torch.ones(1)}}, tmp_path / name)
    else:
        (tmp_path / name).write_text("{}")
    assert f"does not list {name}" in refusal(read, tmp_path)


@pytest.mark.parametrize(
    "name", ["config.json", WEIGHTS, "merges.txt", "chat_template.jinja", "adapter_model.bin"]
)
def test_folders_of_subgoal_models_are_held_to_their_sums(name: str, tmp_path: Path) -> None:
    (tmp_path / "tokenizer.json").write_text("{}")
    write_sums(tmp_path)
    (tmp_path / "LICENSE").write_text("mine")
    check_transformers_folder(tmp_path)
    (tmp_path / name).write_text("{}")
    assert f"does not list {name}" in refusal(check_transformers_folder, tmp_path)


def test_a_subgoal_model_with_two_sets_of_weights_is_refused_before_it_is_loaded(
    tmp_path: Path,
) -> None:
    pytest.importorskip("transformers", reason="subgoal models need the extra `vlm`")
    from mme_vla.subgoal.models.qwen3vl import load_model

    (tmp_path / WEIGHTS).write_text("{}")
    (tmp_path / INDEX).write_text('{"weight_map": {"a": "other.safetensors"}}')
    assert f"both {WEIGHTS} and {INDEX}" in refusal(
        lambda folder: load_model(str(folder)), tmp_path
    )
    check_transformers_folder("owner/name")  # on the hub
