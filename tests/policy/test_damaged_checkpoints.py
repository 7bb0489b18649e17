"""Checkpoints whose files were damaged on the way: found before anything is computed, and said in
one paragraph.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from mme_vla import MMEPolicy, UserError
from mme_vla.policy.tensor_files import save_tensors
from mme_vla.testing.small import SMALL_VISION, small_policy
from mme_vla.training.checkpoint import read_state, restore, save_checkpoint, trainable
from mme_vla.training.optim import EMA
from mme_vla.training.settings import KeepRule
from mme_vla.utils import SUMS, check_sums, write_sums
from mme_vla.weights import load_weights, start_from

DEEP = "[" * 100_000


def tiny() -> MMEPolicy:
    return small_policy("pi05", backbone={"depth": 1, "vision": {**SMALL_VISION, "patch_size": 16}})


def training(policy: MMEPolicy) -> tuple[MMEPolicy, EMA, torch.optim.Optimizer]:
    parameters = trainable(policy)
    return policy, EMA(parameters, 0.9), torch.optim.AdamW(parameters.values(), 1e-3)


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training checkpoint after one update."""
    policy, ema, optimizer = training(tiny())
    for parameter in policy.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    ema.update()
    folder = tmp_path_factory.mktemp("run")
    return save_checkpoint(folder, 1, policy, ema, optimizer, {"train": {"steps": 1}}, KeepRule())


@pytest.fixture
def checkpoint(intact: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(intact, tmp_path / intact.name))


def resume(checkpoint: Path) -> None:
    read_state(checkpoint)
    restore(checkpoint, *training(tiny()))


def refusal(read: Callable[[Path], Any], folder: Path) -> str:
    with pytest.raises(UserError) as caught:
        read(folder)
    assert len(str(caught.value)) <= 2000
    return str(caught.value)


def test_every_file_that_is_read_has_a_sum(checkpoint: Path) -> None:
    listed = {line.split("  ")[1] for line in (checkpoint / SUMS).read_text().splitlines()}
    assert listed == {path.name for path in checkpoint.iterdir()} - {SUMS, "README.md"}
    check_sums(checkpoint, listed)


@pytest.mark.parametrize(
    ("name", "read"),
    [
        *(
            (name, MMEPolicy.from_pretrained)
            for name in (
                "model.safetensors",
                "config.json",
                "processor.json",
                "norm_stats.json",
                "tokenizer.model",
            )
        ),
        *(
            (name, resume)
            for name in (
                "model.safetensors",
                "raw.safetensors",
                "optimizer.safetensors",
                "training_state.json",
            )
        ),
        ("model.safetensors", lambda folder: load_weights(tiny(), folder)),
        ("model.safetensors", lambda folder: start_from(tiny(), folder)),
    ],
)
def test_one_flipped_bit_in_any_file_is_detected(
    name: str, read: Callable[[Path], Any], checkpoint: Path
) -> None:
    read(checkpoint)
    data = bytearray((checkpoint / name).read_bytes())
    data[-20] ^= 1
    (checkpoint / name).write_bytes(data)
    assert f"{name} is damaged" in refusal(read, checkpoint)


def test_a_flipped_bit_in_one_shard_is_detected(tmp_path: Path) -> None:
    policy = tiny()
    policy.save_pretrained(tmp_path)
    (tmp_path / "model.safetensors").unlink()
    save_tensors(policy.state_dict(), tmp_path, max_shard_size="100KB")

    write_sums(tmp_path)
    MMEPolicy.from_pretrained(tmp_path)
    shard = sorted(tmp_path.glob("model-*.safetensors"))[1]
    data = bytearray(shard.read_bytes())
    data[-1] ^= 128
    shard.write_bytes(data)
    assert f"{shard.name} is damaged" in refusal(MMEPolicy.from_pretrained, tmp_path)


@pytest.mark.parametrize(("key", "value"), [("prompt_length", 48), ("prompt", "past_actions")])
def test_settings_in_two_files_must_agree(key: str, value: Any, checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()
    settings = json.loads((checkpoint / "processor.json").read_text())
    assert json.loads((checkpoint / "config.json").read_text())["processor"][key] == settings[key]
    (checkpoint / "processor.json").write_text(json.dumps({**settings, key: value}))
    message = refusal(MMEPolicy.from_pretrained, checkpoint)
    assert f"the processor's {key} is {value!r}, that of the configuration" in message


def test_weights_that_float32_cannot_hold_are_refused(checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()
    tensors = load_file(checkpoint / "model.safetensors")
    name = "backbone.action_in.bias"
    tensors[name] = torch.full_like(tensors[name], 1e300, dtype=torch.float64)
    save_file(tensors, checkpoint / "model.safetensors")
    for read in (MMEPolicy.from_pretrained, lambda folder: start_from(tiny(), folder)):
        assert f"infinities in 1 tensor: {name}" in refusal(read, checkpoint)


def test_statistics_beyond_float32_are_refused(checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()
    stats = json.loads((checkpoint / "norm_stats.json").read_text())
    stats["norm_stats"]["state"].update({"q99": [1e300] * 8})
    (checkpoint / "norm_stats.json").write_text(json.dumps(stats))
    words = "state.q99 must be a list of finite numbers within float32"
    assert words in refusal(MMEPolicy.from_pretrained, checkpoint)


def test_an_unknown_key_of_the_training_state_is_refused(checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()
    state = json.loads((checkpoint / "training_state.json").read_text())
    (checkpoint / "training_state.json").write_text(json.dumps({**state, "stpe": 2}))
    message = refusal(resume, checkpoint)
    assert (
        "training_state.json" in message
        and "Unknown key" in message
        and "stpe" in message
        and "step" in message
    )


def test_a_checkpoint_from_before_there_were_sums_loads_without_a_word(
    checkpoint: Path, recwarn: pytest.WarningsRecorder
) -> None:
    (checkpoint / SUMS).unlink()
    MMEPolicy.from_pretrained(checkpoint)
    resume(checkpoint)
    assert list(recwarn) == []


@pytest.mark.parametrize(
    "content", [DEEP, "[]"], ids=["deep", "list"]
)  # others: tests/utils/test_files.py
@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("config.json", MMEPolicy.from_pretrained), ("processor.json", MMEPolicy.from_pretrained),
        ("norm_stats.json", MMEPolicy.from_pretrained), ("training_state.json", resume),
        ("model.safetensors.index.json", MMEPolicy.from_pretrained),
    ],
)  # fmt: skip
def test_damaged_json_is_one_short_paragraph(
    name: str, read: Callable[[Path], Any], content: str, checkpoint: Path
) -> None:
    (checkpoint / SUMS).unlink()
    (checkpoint / name).write_bytes(content.encode("utf-8", "surrogatepass"))
    assert name in refusal(read, checkpoint)


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("processor.json", {"prompt": []}),
        ("processor.json", {"embodiment": [1]}),
        ("processor.json", {"prompt_length": 10**9}),
        ("processor.json", {"tokenizer": None}),
        ("processor.json", {"stats": 3}),
        ("processor.json", {"x" * 9999: 1}),
        ("processor.json", {"image_size": 3}),
        ("config.json", {"backbone": 3}),
        ("config.json", {"memory": [1]}),
        ("config.json", {"policy": []}),
        ("config.json", {"adapters": {"rank": 0}}),
        ("config.json", {"plugins": [1]}),
        ("config.json", {"plugins": 7}),
        ("config.json", {"integration": {"name": []}}),
        ("norm_stats.json", {"norm_stats": {"state": {"mean": [10**400]}, "actions": {}}}),
        ("norm_stats.json", {"norm_stats": {str(i): 0 for i in range(9999)}}),
    ],
)
def test_values_of_the_wrong_kind_are_one_short_paragraph(
    name: str, changes: dict[str, Any], checkpoint: Path
) -> None:
    (checkpoint / SUMS).unlink()
    content = json.loads((checkpoint / name).read_text())
    (checkpoint / name).write_text(json.dumps({**content, **changes}))
    refusal(MMEPolicy.from_pretrained, checkpoint)


def test_thousands_of_names_are_one_short_paragraph(checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()
    save_file(
        {f"{'x' * 200}{i}": torch.zeros(1) for i in range(2000)}, checkpoint / "model.safetensors"
    )
    assert "2,000 unexpected" in refusal(MMEPolicy.from_pretrained, checkpoint)
    save_file(
        {f"{'x' * 200}{i}": torch.zeros(1) for i in range(2000)}, checkpoint / "raw.safetensors"
    )
    refusal(resume, checkpoint)


def test_moments_that_are_no_numbers_are_refused(checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()

    moments = load_file(checkpoint / "optimizer.safetensors")
    name = next(name for name in moments if name.endswith("exp_avg"))
    save_file({**moments, name: moments[name] * float("nan")}, checkpoint / "optimizer.safetensors")
    assert name in refusal(resume, checkpoint)


@pytest.mark.parametrize("key", ["memroy", "extra", "Backbone"])
def test_an_unknown_section_of_a_configuration_is_refused_with_the_known_ones(
    key: str, checkpoint: Path
) -> None:
    config = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps({**config, key: {}}))
    (checkpoint / SUMS).unlink()
    message = refusal(MMEPolicy.from_pretrained, checkpoint)
    assert repr(key) in message and "integration" in message


@pytest.mark.parametrize("section", [[["name", "framesamp"]], "framesamp", 3, True])
def test_a_section_that_is_no_mapping_is_refused_by_name(section: Any, checkpoint: Path) -> None:
    config = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps({**config, "memory": section}))
    (checkpoint / SUMS).unlink()
    assert "memory=" in refusal(MMEPolicy.from_pretrained, checkpoint)


def test_a_backbone_of_null_is_a_missing_section(checkpoint: Path) -> None:
    config = json.loads((checkpoint / "config.json").read_text())
    (checkpoint / "config.json").write_text(json.dumps({**config, "backbone": None}))
    (checkpoint / SUMS).unlink()
    message = refusal(MMEPolicy.from_pretrained, checkpoint)
    assert "lacks the section 'backbone'" in message


def test_a_training_state_of_another_step_than_its_folder_is_refused(checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()
    state = json.loads((checkpoint / "training_state.json").read_text())
    (checkpoint / "training_state.json").write_text(json.dumps({**state, "step": 500}))
    assert "has step 500, but its folder is called step_000001" in refusal(read_state, checkpoint)


@pytest.mark.parametrize("edit", ["missing", "wide"])
def test_an_optimizer_state_of_another_form_is_refused(edit: str, checkpoint: Path) -> None:
    (checkpoint / SUMS).unlink()
    moments = load_file(checkpoint / "optimizer.safetensors")
    name = "backbone.action_in.bias"
    if edit == "missing":
        del moments[f"{name}/exp_avg"]
    else:
        moments[f"{name}/step"] = torch.ones(3)
    save_file(moments, checkpoint / "optimizer.safetensors")
    assert f"{name}/" in refusal(resume, checkpoint)
