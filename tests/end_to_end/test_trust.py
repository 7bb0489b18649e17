"""A untrusted checkpoint: nothing it says leaves its folder, runs, or takes more memory than it has
bytes.
"""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import torch
from safetensors.torch import load_file, save_file

from mme_vla import MMEPolicy, UserError
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.evaluation import default_output
from mme_vla.processing.tokenizer import PALIGEMMA
from mme_vla.testing.small import SMALL_VISION, small_policy
from mme_vla.utils import SUMS, Sums, check_sums, inside
from mme_vla.weights import load_weights, open_source, read_stats
from mme_vla.weights.orbax import read_orbax, write_orbax


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return small_policy(
        "framesamp_context", backbone={"vision": {**SMALL_VISION, "patch_size": 16}}
    )


@pytest.fixture
def folder(policy: MMEPolicy, tmp_path: Path) -> Path:
    """A checkpoint without sums, which an untrusted source would leave out."""
    policy.save_pretrained(tmp_path / "checkpoint")
    (tmp_path / "checkpoint" / SUMS).unlink()
    return tmp_path / "checkpoint"


def change(file: Path, edit: Callable[[Any], None]) -> None:
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def index_names(folder: Path, name: str) -> None:
    (folder / "model.safetensors").rename(folder.parent / "outside.safetensors")
    table = dict.fromkeys(load_file(folder.parent / "outside.safetensors"), name)
    (folder / "model.safetensors.index.json").write_text(json.dumps({"weight_map": table}))


def move_out(folder: Path, name: str) -> None:
    (folder / name).rename(folder.parent / name)
    (folder / name).symlink_to(folder.parent / name)


def processor_says(folder: Path, **values: Any) -> None:
    change(folder / "processor.json", lambda config: config.update(values))


OUTSIDE: dict[str, Callable[[Path], None]] = {
    "index above": lambda folder: index_names(folder, "../outside.safetensors"),
    "index absolute": lambda folder: index_names(
        folder, str(folder.parent / "outside.safetensors")
    ),
    "linked weights": lambda folder: move_out(folder, "model.safetensors"),
    "linked config": lambda folder: move_out(folder, "config.json"),
    "linked processor": lambda folder: move_out(folder, "processor.json"),
    "linked tokenizer": lambda folder: move_out(folder, "tokenizer.model"),
    "linked statistics": lambda folder: move_out(folder, "norm_stats.json"),
    "absolute tokenizer": lambda folder: processor_says(
        folder, tokenizer=str(folder / "tokenizer.model")
    ),
    "tokenizer above": lambda folder: processor_says(
        folder, tokenizer="../checkpoint/tokenizer.model"
    ),
    "absolute statistics": lambda folder: processor_says(
        folder, stats=str(folder / "norm_stats.json")
    ),
}


@pytest.mark.parametrize("attack", OUTSIDE)
def test_nothing_outside_the_folder_is_read(attack: str, folder: Path) -> None:
    OUTSIDE[attack](folder)
    if attack == "tokenizer above":
        (folder / "tokenizer.model").rename(folder.parent / "tokenizer.model")
        processor_says(folder, tokenizer="../tokenizer.model")
    if attack == "absolute tokenizer":
        shutil.copy(folder / "tokenizer.model", folder.parent / "other.model")
        processor_says(folder, tokenizer=str(folder.parent / "other.model"))
    with pytest.raises(UserError, match="lies outside of it"):
        MMEPolicy.from_pretrained(folder)


def test_statistics_of_foreign_checkpoints_stay_in_their_folder(tmp_path: Path) -> None:
    folder = tmp_path / "theirs"
    folder.mkdir()
    save_file({"x": torch.zeros(1)}, tmp_path / "secret.safetensors")
    for place in ("../secret.safetensors", str(tmp_path / "secret.safetensors")):
        (folder / "policy_preprocessor.json").write_text(
            json.dumps({"steps": [{"state_file": place}]})
        )
        with pytest.raises(UserError, match="lies outside of it"):
            read_stats(folder)
    (folder / "policy_preprocessor.json").unlink()
    (tmp_path / "norm_stats.json").write_text("{}")
    (folder / "assets" / "robot").mkdir(parents=True)
    (folder / "assets" / "robot" / "norm_stats.json").symlink_to(tmp_path / "norm_stats.json")
    with pytest.raises(UserError, match="lies outside of it"):
        read_stats(folder)


def test_a_snapshot_of_the_hubs_cache_loads_through_its_links(
    folder: Path, policy: MMEPolicy, tmp_path: Path
) -> None:
    repository = tmp_path / "models--group--policy"
    snapshot = repository / "snapshots" / "0123abc"
    snapshot.mkdir(parents=True)
    (repository / "blobs").mkdir()
    policy.save_pretrained(folder)  # with sums
    for number, file in enumerate(sorted(folder.iterdir())):
        shutil.move(file, repository / "blobs" / f"blob{number}")
        (snapshot / file.name).symlink_to(Path("..", "..", "blobs", f"blob{number}"))
    loaded = MMEPolicy.from_pretrained(snapshot)
    assert all(
        torch.equal(tensor, loaded.state_dict()[name])
        for name, tensor in policy.state_dict().items()
    )
    listed = Sums(snapshot).table
    assert listed
    check_sums(snapshot, listed)

    outside = tmp_path / "outside.json"
    shutil.copy(snapshot / "config.json", outside)
    blob = (snapshot / "config.json").resolve()
    blob.unlink()
    blob.symlink_to(outside)  # a blob that is itself a way out
    with pytest.raises(UserError, match="lies outside of it"):
        MMEPolicy.from_pretrained(snapshot)
    with pytest.raises(UserError, match="lies outside of it"):
        inside(snapshot, "../../blobs/blob0")


def test_a_folder_that_imitates_the_hubs_cache_opens_nothing_else(
    folder: Path, tmp_path: Path
) -> None:
    not_the_cache = tmp_path / "runs" / "snapshots" / "one"
    not_the_cache.parent.mkdir(parents=True)
    folder.rename(not_the_cache)
    (tmp_path / "runs" / "blobs").mkdir()
    shutil.move(not_the_cache / "config.json", tmp_path / "runs" / "blobs" / "x")
    (not_the_cache / "config.json").symlink_to(tmp_path / "runs" / "blobs" / "x")
    with pytest.raises(UserError, match="lies outside of it"):
        MMEPolicy.from_pretrained(not_the_cache)


def test_the_network_is_requested_nothing_but_the_librarys_tokenizer(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests: list[str] = []

    def fetch(repository: str, name: str) -> str:
        requests.append(f"{repository}/{name}")
        return str(folder / "tokenizer.model")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", fetch)
    (folder / "tokenizer.model").rename(folder.parent / "tokenizer.model")
    processor_says(folder, tokenizer="hf://evil/group/tokenizer.model")
    with pytest.raises(
        UserError, match=r"hf://evil/group/tokenizer\.model.*tokenizer=.*as tokenizer\.model"
    ):
        MMEPolicy.from_pretrained(folder)
    assert requests == []
    (folder.parent / "tokenizer.model").rename(folder / "tokenizer.model")  # as the message says
    MMEPolicy.from_pretrained(folder)
    assert requests == []
    MMEPolicy.from_pretrained(folder, tokenizer="hf://evil/group/tokenizer.model")
    processor_says(folder, tokenizer=PALIGEMMA)
    MMEPolicy.from_pretrained(folder)
    assert requests == ["evil/group/tokenizer.model", "google/paligemma-3b-pt-224/tokenizer.model"]


@pytest.mark.parametrize("name", ["../../x", "/x", "a/b", "..", ""])
def test_the_name_of_a_checkpoint_decides_no_place(name: str) -> None:
    with pytest.raises(UserError, match="cannot name a folder"):
        default_output(RunKey(name, 3, 42))


def test_nothing_is_resolved_from_the_environment(
    policy: MMEPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("tensorstore", reason="Orbax checkpoints need the extra 'orbax'")
    from mme_vla.cli.weights import convert

    monkeypatch.setenv("SECRET", "hidden-word")
    write_orbax({"PaliGemma/x": torch.zeros(2)}, tmp_path / "run" / "0" / "params")
    for words in ("${oc.env:SECRET}", "pi05,${oc.env:SECRET}", "../../x\n", "x" * 4000):
        (tmp_path / "run" / "history_config.txt").write_text(words)
        with pytest.raises(UserError, match="no variant of the released code") as caught:
            convert(tmp_path / "run", tmp_path / "out", dry_run=True)
        assert "hidden-word" not in str(caught.value)
        assert len(str(caught.value)) < 2000


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_no_numbers_are_refused_by_name(
    value: float, folder: Path, policy: MMEPolicy
) -> None:
    tensors = load_file(folder / "model.safetensors")
    tensors["backbone.time_in.bias"][3] = value
    save_file(tensors, folder / "model.safetensors")
    for load in (
        MMEPolicy.from_pretrained,
        lambda place: load_weights(small_policy("framesamp_context"), place),
    ):
        with pytest.raises(
            UserError, match=r"NaN or infinities in 1 tensor: backbone\.time_in\.bias|misshapen"
        ):
            load(folder)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("depth", 10**12),
        ("depth", 2),
        ("head_dim", 10**30),
        ("horizon", 7),
        ("depth", "2"),
        ("vlm", []),
        ("depth", None),
    ],
)
def test_a_configuration_that_says_other_things_than_the_weights_is_refused(
    key: str, value: Any, folder: Path
) -> None:
    change(folder / "config.json", lambda config: config["backbone"].update({key: value}))
    with pytest.raises(UserError) as caught:
        MMEPolicy.from_pretrained(folder)
    assert len(str(caught.value)) <= 2000


def test_a_header_larger_than_any_is_not_parsed(folder: Path) -> None:
    with (folder / "model.safetensors").open("r+b") as file:
        file.write((2**40).to_bytes(8, "little"))
    for load in (MMEPolicy.from_pretrained, open_source):
        with pytest.raises(UserError, match="header would have"):
            load(folder)
    (folder / "model.safetensors").unlink()
    os.mkfifo(folder / "model.safetensors")
    with pytest.raises(UserError, match="No weights"):
        MMEPolicy.from_pretrained(folder)


def test_missing_pieces_of_an_array_are_errors_and_not_zeros(tmp_path: Path) -> None:
    pytest.importorskip("tensorstore", reason="Orbax checkpoints need the extra 'orbax'")
    folder = tmp_path / "plain"
    shutil.copytree(Path(__file__).resolve().parents[1] / "data" / "orbax_plain", folder)
    (folder / "scale" / "0").unlink()
    with pytest.raises(UserError, match="damaged: it cannot be read as an Orbax checkpoint"):
        read_orbax(folder)


def test_shapes_are_compared_before_memory_is_taken(tmp_path: Path, policy: MMEPolicy) -> None:
    pytest.importorskip("tensorstore", reason="Orbax checkpoints need the extra 'orbax'")
    folder = tmp_path / "plain"
    shutil.copytree(Path(__file__).resolve().parents[1] / "data" / "orbax_plain", folder)
    change(folder / "scale" / ".zarray", lambda about: about.update(shape=[10**11], chunks=[1]))
    with pytest.raises(UserError, match="do not fit this policy"):
        load_weights(small_policy("framesamp_modul"), folder)
    change(folder / "scale" / ".zarray", lambda about: about.update(shape=[4], chunks=[10**11]))
    with pytest.raises(UserError, match="pieces of"):
        read_orbax(folder)
    (folder / "scale" / "link").symlink_to("/etc")
    with pytest.raises(UserError, match="lies outside of it"):
        read_orbax(folder)
