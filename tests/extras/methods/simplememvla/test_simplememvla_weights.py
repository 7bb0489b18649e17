"""SimpleMemVLA's published folders: written, read again, and refused where they do not fit."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

pytest.importorskip("transformers", reason="needs the extra `vlm`: uv sync --inexact --extra vlm")

from helpers.memory_fakes import same
from mme_vla import UserError, build_policy
from mme_vla.cli.weights import convert
from mme_vla.extras.methods.simplememvla.weights import PublishedConfig
from mme_vla.policy.base import Policy
from mme_vla.testing.small import unit_stats
from mme_vla.weights.load import load_weights, transfer
from mme_vla.weights.source import open_source
from mme_vla.weights.statistics import read_stats
from mme_vla.weights.writers import write_policy

LM_HEAD = "backbone.lm_head.weight"


def tiny(seed: int = 1, **options: Any) -> Policy:
    policy = build_policy("simplememvla", seed=seed, **options)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("published")
    policy = tiny()
    write_policy(policy, folder, "simplememvla", torch.float32, policy.require_processor().stats)
    return folder


def test_a_published_folder_is_written_and_read_again(published: Path, tmp_path: Path) -> None:
    assert open_source(published).format == "simplememvla"
    tensors = load_file(published / "model.safetensors")
    assert torch.equal(
        tensors[LM_HEAD], tensors["backbone.model.language_model.embed_tokens.weight"]
    )
    config = json.loads((published / "config.json").read_text())
    assert (config["history_video_sec"], config["action_horizon"], config["native_video_fps"]) == (
        60,
        30,
        20,
    )
    policy, other = tiny(1), tiny(2)
    load_weights(other, published)
    assert same(policy, other)
    stats = read_stats(published)
    assert (
        stats is not None
        and stats.state.mean.tolist() == policy.require_processor().stats.state.mean.tolist()
    )  # type: ignore[union-attr]
    del tensors[LM_HEAD]
    # also without the tied head, and without a description
    save_file(tensors, tmp_path / "model.safetensors")
    load_weights(tiny(3), tmp_path)


def test_a_folder_brings_its_window_and_sizes(published: Path, tmp_path: Path) -> None:
    source = tmp_path / "source"
    shutil.copytree(published, source)
    config = json.loads((source / "config.json").read_text())
    (source / "config.json").write_text(
        json.dumps(config | {"history_video_sec": 3, "robot_tag": "Two arms"})
    )
    convert(source, tmp_path / "ours", ["processor=simplememvla_tiny", "backbone.image_size=32"])
    settings = Policy.from_pretrained(tmp_path / "ours").require_processor().settings  # type: ignore[attr-defined]
    assert (settings.seconds, settings.robot) == (3, "Two arms")
    convert(tmp_path / "ours", tmp_path / "theirs", to="simplememvla")
    assert json.loads((tmp_path / "theirs" / "config.json").read_text())["history_video_sec"] == 3


def test_qwen_is_a_start_without_a_head(published: Path, tmp_path: Path) -> None:
    tensors = load_file(published / "model.safetensors")
    base = {
        name.removeprefix("backbone."): t
        for name, t in tensors.items()
        if name.startswith("backbone.")
    }
    base["mtp.layers.0.weight"] = torch.zeros(2, 2)
    save_file(base, tmp_path / "model.safetensors")
    policy = tiny(2)
    took = transfer(policy, tmp_path)
    assert all(name.startswith("action_head.") for name in took.new)
    assert all(torch.equal(tensors[name], policy.state_dict()[name]) for name in took.taken)
    memory = tiny(2, memory="framesamp", **{"memory.grid": 2, "memory.budget": 8})
    assert any(name.startswith("memory.") for name in transfer(memory, published).new)
    with pytest.raises(UserError, match="missing"):
        load_weights(policy, tmp_path)


def test_a_checkpoint_that_does_not_fit_is_refused(published: Path, tmp_path: Path) -> None:
    def copy(name: str) -> Path:
        return Path(shutil.copytree(published, tmp_path / name))

    config = json.loads((published / "config.json").read_text())
    other = copy("other_window")
    (other / "config.json").write_text(json.dumps(config | {"history_video_sec": 30}))
    with pytest.raises(UserError, match=r"processor\.seconds=30.*this policy has 60"):
        load_weights(tiny(), other)
    rate = copy("other_rate")
    (rate / "config.json").write_text(json.dumps(config | {"native_video_fps": 15}))
    with pytest.raises(UserError, match=r"processor\.native_fps=15"):
        load_weights(tiny(), rate)
    foreign = copy("foreign")
    (foreign / "config.json").write_text(json.dumps({**config, "model_type": "pi05"}))
    with pytest.raises(UserError, match="model_type"):
        load_weights(tiny(), foreign)
    damaged = copy("damaged")
    content = (damaged / "model.safetensors").read_bytes()
    (damaged / "model.safetensors").write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match="damaged"):
        load_weights(tiny(), damaged)
    with pytest.raises(UserError, match=r"holds SimpleMemVLA; pi05 is a MMEPolicy"):
        load_weights(build_policy("pi05"), published)
    with pytest.raises(UserError, match="memory in its place"):
        load_weights(tiny(memory="framesamp", **{"memory.grid": 2, "memory.budget": 8}), published)


def changed(published: Path, folder: Path, **changes: Any) -> Path:
    """A copy of a published folder whose config.json has other values; `...` leaves a key out."""
    shutil.copytree(published, folder)
    config = json.loads((published / "config.json").read_text()) | changes
    values = {key: value for key, value in config.items() if value is not ...}
    (folder / "config.json").write_text(json.dumps(values))
    return folder


def test_an_unused_state_and_no_video_may_be_null(published: Path, tmp_path: Path) -> None:
    config = json.loads((published / "config.json").read_text())
    config |= {"use_proprio": False, "state_dim": None, "history_image_keys": None}
    config |= {"robot_tag": None, "native_video_fps": None}
    settings = PublishedConfig.read(config, published).settings()
    assert settings["backbone.state_dim"] == 0
    assert settings["processor.robot"] is None and settings["processor.native_fps"] is None
    assert settings["backbone.head.rope_section"] == config["dit_mrope_section"]
    load_weights(tiny(1), changed(published, tmp_path / "silent", history_image_keys=None))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"use_proprio": True, "state_dim": None}, r"here: config\.json: state_dim=None"),
        ({"dit_depth": ..., "image_keys": ...}, r"no SimpleMemVLA's: it lacks dit_depth, image_k"),
        ({"dit_depth": "two"}, r"here: config\.json\.dit_depth='two' must be a whole number"),
        ({"timestep_beta_beta": 2}, r"here: config\.json: timestep_beta_beta=2; only 1"),
        ({"dit_mrope_section": [11, 11, 11]}, r"Set backbone\.head\.rope_section=\[11, 11, 11\]"),
    ],
)
def test_what_a_published_configuration_lacks_is_named(
    changes: dict[str, Any], words: str, published: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match=words):
        load_weights(tiny(1), changed(published, tmp_path / "here", **changes))


def test_a_missing_tokenizer_or_processor_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"No tokenizer at .*nowhere.*processor\.tokenizer"):
        build_policy("simplememvla", processor={"tokenizer": str(tmp_path / "nowhere")})
    (tmp_path / "tokenizer.json").write_text("{")
    with pytest.raises(UserError, match=r"is no tokenizer\.json"):
        build_policy("simplememvla", processor={"tokenizer": str(tmp_path)})
    tiny().save_pretrained(tmp_path / "saved")
    (tmp_path / "saved" / "processor.json").unlink()
    with pytest.raises(UserError, match=r"No processor\.json"):
        Policy.from_pretrained(tmp_path / "saved")
