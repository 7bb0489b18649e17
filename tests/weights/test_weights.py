"""The commands of weights: loading, starting another variant, converting, and the statistics beside
foreign weights.
"""

import json
import re
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from helpers.memory_fakes import same
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.cli.weights import convert, main
from mme_vla.testing.small import PERCEPTUAL, random_batch, small_policy, unit_stats
from mme_vla.utils import write_json
from mme_vla.weights import (
    load_weights,
    open_source,
    read_stats,
    start_from,
    transfer,
)
from mme_vla.weights.released import released_table
from mme_vla.weights.tables import memory_parameters

pytest.importorskip("tensorstore", reason="Orbax checkpoints need the extra 'orbax'")
FORMATS = ["ours", "lerobot", "openpi", "released"]


@pytest.fixture(scope="module")
def bases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """One memoryless policy in every format."""
    folder = tmp_path_factory.mktemp("bases")
    small_policy("pi05", seed=5).save_pretrained(folder / "ours")
    for fmt in FORMATS[1:]:
        convert(folder / "ours", folder / fmt, to=fmt)
    return {fmt: folder / fmt for fmt in FORMATS}


@pytest.fixture(scope="module")
def base(bases: dict[str, Path]) -> MMEPolicy:
    """That policy itself, to compare with."""
    return MMEPolicy.from_pretrained(bases["ours"])


@pytest.mark.parametrize("fmt", FORMATS)
def test_every_format_is_reported_and_fills_a_policy_on_meta(
    fmt: str, bases: dict[str, Path], base: MMEPolicy
) -> None:
    assert open_source(bases[fmt]).format == fmt
    loaded = load_weights(build_policy("pi05", device="meta"), bases[fmt])
    assert same(loaded, base)
    assert all(p.requires_grad for p in loaded.parameters())


@pytest.mark.parametrize(
    ("variant", "fmt"),
    [
        *(("framesamp_modul", fmt) for fmt in FORMATS[:-1]),
        *((variant, "released") for variant in PERCEPTUAL),
    ],
)
def test_only_the_memorys_parameters_are_new_when_starting_from_pi05(
    variant: str, fmt: str, bases: dict[str, Path], base: MMEPolicy
) -> None:
    policy, loaded = build_policy(variant), base.state_dict()
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    new = start_from(policy, bases[fmt])
    assert set(new) == memory_parameters(policy) == set(before) - set(loaded)
    assert new
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, before[name] if name in new else loaded[name]), name


def test_another_variants_memory_is_left_behind_and_reported(tmp_path: Path) -> None:
    small_policy("framesamp_expert").save_pretrained(tmp_path / "expert")
    convert(tmp_path / "expert", tmp_path / "released", to="released")
    for source in ("expert", "released"):
        policy = small_policy("pi05", seed=3)
        start = transfer(policy, tmp_path / source)
        assert start.new == []
        assert start.left
        assert "left behind" in str(start)
        assert torch.equal(
            policy.backbone.action_in.weight,
            MMEPolicy.from_pretrained(tmp_path / "expert").backbone.action_in.weight,
        )


@pytest.mark.slow
def test_the_same_variant_starts_completely(tmp_path: Path) -> None:
    small_policy("framesamp_modul", seed=5).save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "released", to="released")
    for source in ("ours", "released"):
        policy = build_policy("framesamp_modul")
        assert start_from(policy, tmp_path / source) == []
        assert same(policy, MMEPolicy.from_pretrained(tmp_path / "ours"))


def test_a_start_never_hides_what_is_missing(bases: dict[str, Path], tmp_path: Path) -> None:
    tensors = open_source(bases["ours"]).tensors()
    del tensors["backbone.time_in.bias"]
    tensors["backbone.embedding.weight"] = torch.zeros(7, 64)
    save_file(tensors, tmp_path / "model.safetensors")
    policy = build_policy("framesamp_modul")
    before = policy.backbone.action_in.weight.clone()
    with pytest.raises(
        UserError, match=r"(?s)1 missing:\s+backbone\.time_in\.bias.*embedding.*instead of"
    ):
        start_from(policy, tmp_path)
    assert torch.equal(policy.backbone.action_in.weight, before)
    with pytest.raises(UserError, match="real device"):
        start_from(build_policy("framesamp_modul", device="meta"), bases["ours"])


def test_another_tokenizer_is_no_start_and_is_not_loaded(
    bases: dict[str, Path], tmp_path: Path
) -> None:
    MMEPolicy.from_pretrained(bases["ours"]).save_pretrained(tmp_path)
    about = json.loads((tmp_path / "processor.json").read_text())
    (tmp_path / "processor.json").write_text(
        json.dumps({**about, "tokenizer_fingerprint": "another"})
    )
    (tmp_path / "SHA256SUMS").unlink()
    with pytest.raises(UserError, match="another tokenizer"):
        start_from(build_policy("framesamp_modul"), tmp_path)
    with pytest.raises(UserError, match="another tokenizer"):
        load_weights(build_policy("pi05"), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["pi05", "simplesg", "groundsg", *PERCEPTUAL])
def test_conversion_there_and_back_keeps_every_bit(variant: str, tmp_path: Path) -> None:
    policy = small_policy(variant)
    policy.save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "released", to="released")
    assert (tmp_path / "released" / "history_config.txt").is_file() == (variant != "pi05")
    convert(tmp_path / "released", tmp_path / "back", ["backbone=tiny"])
    first, last = tmp_path / "ours", tmp_path / "back"
    assert (first / "model.safetensors").read_bytes() == (last / "model.safetensors").read_bytes()
    back, batch = MMEPolicy.from_pretrained(last), random_batch(policy)
    assert back.config["name"] == policy.config["name"]
    noise = torch.zeros_like(batch.actions)
    assert torch.equal(back.sample_actions(batch, noise), policy.sample_actions(batch, noise))
    assert back.require_processor().stats is not None


def test_a_destination_is_never_overwritten_and_a_failure_leaves_nothing(
    bases: dict[str, Path], tmp_path: Path
) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(UserError, match="exists"):
        convert(bases["ours"], tmp_path / "there", to="lerobot")
    with pytest.raises(UserError, match="misshapen"):
        convert(bases["lerobot"], tmp_path / "new", ["backbone=tiny", "backbone.vlm.width=128"])
    small_policy("tokendrop_modul").save_pretrained(tmp_path / "memory")
    with pytest.raises(UserError, match="memoryless"):
        convert(tmp_path / "memory", tmp_path / "new", to="openpi")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["memory", "there"]


def test_a_dry_run_prints_the_mapping_and_makes_no_folder(
    bases: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    convert(bases["openpi"], tmp_path / "none", ["backbone=tiny"], to="lerobot", dry_run=True)
    printed = capsys.readouterr().out
    assert not (tmp_path / "none").exists()
    assert "openpi" in printed.splitlines()[0] and "every tensor fits" in printed.splitlines()[0]
    for side in ("read", "written"):
        for heading in ("mapped", "unread", "tied", "derived"):
            assert f"\n{side}, {heading}" in printed
    assert re.search(r"\n  \S*action_in_proj.weight \[\S+\] → backbone.action_in.weight,", printed)
    assert re.search(r"\n  \S+layers\.\*\S+ \[\S+\] → \S+layers\.\*\S+, \d+ tensors\n", printed)


def test_a_robot_comes_from_a_folder_of_yaml_files(
    bases: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "embodiment").mkdir()
    (tmp_path / "embodiment/arm.yaml").write_text(
        "name: arm\ncameras: {head: {}}\nstate: {width: 8}\naction: {width: 8, horizon: 20}\n"
    )
    words = [str(bases["openpi"]), str(tmp_path / "arm"), "backbone=tiny", "embodiment=arm"]
    with pytest.raises(SystemExit):
        main(words)
    assert "--config-dir DIR" in capsys.readouterr().err
    main([*words, "--config-dir", str(tmp_path)])
    assert "arm: save_pretrained() of this library, weights in float32." in capsys.readouterr().out
    assert MMEPolicy.from_pretrained(tmp_path / "arm").embodiment.camera_names == ("head",)


def test_the_variant_a_run_names_cannot_be_overruled(tmp_path: Path) -> None:
    small_policy("framesamp_modul").save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "released", to="released")
    with pytest.raises(UserError, match="says it is framesamp_modul"):
        convert(tmp_path / "released", tmp_path / "x", ["model=framesamp_expert", "backbone=tiny"])
    with pytest.raises(UserError, match="brings its own configuration"):
        convert(tmp_path / "ours", tmp_path / "x", ["model=framesamp_expert"])


def test_foreign_and_broken_sources_say_what_is_wrong(
    bases: dict[str, Path], tmp_path: Path
) -> None:
    policy = build_policy("pi05")
    with pytest.raises(UserError, match="no such file"):
        load_weights(policy, tmp_path / "nowhere")
    with pytest.raises(UserError, match="no checkpoint of a known kind"):
        load_weights(policy, tmp_path)
    save_file({"layer.weight": torch.zeros(2)}, tmp_path / "other.safetensors")
    with pytest.raises(UserError, match=r"no policy of a known kind.*layer\.weight"):
        load_weights(policy, tmp_path / "other.safetensors")
    content = (bases["lerobot"] / "model.safetensors").read_bytes()
    (tmp_path / "cut.safetensors").write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match="damaged"):
        load_weights(policy, tmp_path / "cut.safetensors")
    (tmp_path / "adapter_model.safetensors").write_bytes(b"")
    with pytest.raises(UserError, match="PEFT adapter"):
        load_weights(policy, tmp_path)
    (tmp_path / "model.safetensors.index.json").write_text('{"weight_map": 3}')
    with pytest.raises(UserError, match="not an index"):
        load_weights(policy, tmp_path)
    (tmp_path / "model.safetensors.index.json").write_text(
        '{"weight_map": {"a": "shard.safetensors"}}'
    )
    with pytest.raises(UserError, match=r"shard\.safetensors"):
        load_weights(policy, tmp_path)


def test_a_memory_of_the_user_starts_from_a_released_base(
    bases: dict[str, Path], monkeypatch: Any
) -> None:
    policy = build_policy("framesamp_context")
    monkeypatch.setattr("mme_vla.weights.names.jax_memory.released_names", lambda memory: {})
    with pytest.raises(UserError, match="no released names"):
        released_table(policy)
    assert set(start_from(policy, bases["released"])) == memory_parameters(policy)


# Statistics


@pytest.mark.parametrize("fmt", FORMATS)
def test_statistics_come_with_the_weights_of_this_library(fmt: str, bases: dict[str, Path]) -> None:
    loaded = load_weights(build_policy("pi05"), bases[fmt])
    assert loaded.require_processor().require_stats().to_dict() == unit_stats().to_dict()


def test_of_several_datasets_statistics_none_is_taken_with_a_report(
    bases: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "base"
    shutil.copytree(bases["openpi"], folder)
    (folder / "assets" / "droid").mkdir(parents=True)
    unit_stats().save(folder / "assets" / "droid" / "norm_stats.json")
    policy = build_policy("pi05")
    with pytest.warns(
        UserWarning, match=r"statistics of droid, robomme; none were taken.*read_stats\("
    ):
        load_weights(policy, folder)
    assert policy.require_processor().stats is None


def test_statistics_of_openpi_and_of_several_datasets(tmp_path: Path) -> None:
    assert read_stats(tmp_path) is None
    for asset in ("robomme", "droid"):
        (tmp_path / "assets" / asset).mkdir(parents=True)
        unit_stats().save(tmp_path / "assets" / asset / "norm_stats.json")
    with pytest.raises(UserError, match=r"droid, robomme.*asset"):
        read_stats(tmp_path)
    with pytest.raises(UserError, match="none of 'libero'"):
        read_stats(tmp_path, "libero")
    statistics = read_stats(tmp_path, "robomme")
    assert statistics is not None
    assert statistics.to_dict() == unit_stats().to_dict()


def test_statistics_of_a_lerobot_processor_come_from_the_file_its_json_names(
    tmp_path: Path,
) -> None:
    file = "policy_preprocessor_step_7_normalizer_processor.safetensors"
    steps = [
        {"registry_name": "to_batch"},
        {"registry_name": "normalizer_processor", "state_file": file},
    ]
    (tmp_path / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}))
    low, high = -torch.arange(1.0, 9.0), torch.arange(1.0, 9.0)
    values = {
        "mean": torch.zeros(8),
        "std": torch.ones(8),
        "q01": low,
        "q99": high,
        "min": low,
        "count": torch.ones(1),
    }
    features = ("action", "observation.state")
    save_file(
        {f"{f}.{key}": value.clone() for f in features for key, value in values.items()},
        tmp_path / file,
    )
    stats = read_stats(tmp_path)
    assert stats is not None
    assert stats.actions.q99.tolist() == high.tolist()
    assert stats.state.q01.tolist() == low.tolist()
    (tmp_path / file).unlink()
    with pytest.raises(UserError, match="normalizer_processor"):
        read_stats(tmp_path)


def test_a_released_run_is_named_after_its_parts_whatever_the_model_is_called(
    tmp_path: Path,
) -> None:
    policy = build_policy("framesamp_modul", memory="tokendrop")
    policy.save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "released", to="released")
    assert open_source(tmp_path / "released").variants == ["tokendrop_modul"]


@pytest.mark.parametrize("relative", [True, False])
def test_lerobots_statistics_of_absolute_actions_are_left_out_with_a_warning(
    relative: bool, bases: dict[str, Path], tmp_path: Path
) -> None:
    folder = tmp_path / "lerobot"
    shutil.copytree(bases["lerobot"], folder)
    (folder / "norm_stats.json").unlink()
    about = json.loads((folder / "config.json").read_text())
    write_json(folder / "config.json", {**about, "use_relative_actions": relative})
    step = {"registry_name": "normalizer_processor", "state_file": "stats.safetensors"}
    write_json(folder / "policy_preprocessor.json", {"steps": [step]})
    stats = unit_stats()
    tensors = {}
    for feature, values in (("observation.state", stats.state), ("action", stats.actions)):
        for key, value in values.to_dict().items():
            tensors[f"{feature}.{key}"] = torch.tensor(value)
    save_file(tensors, folder / "stats.safetensors")
    caught = nullcontext() if relative else pytest.warns(UserWarning, match="absolute actions")
    with caught:
        convert(folder, tmp_path / "ours", ["backbone=tiny"])
    taken = MMEPolicy.from_pretrained(tmp_path / "ours").require_processor().stats
    assert (taken is not None) == relative


def test_statistics_are_selected_before_the_weights_are_read(
    bases: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mme_vla.cli.weights.read_as", lambda *_: pytest.fail("read"))
    with pytest.raises(UserError, match="none of 'droid'"):
        convert(bases["openpi"], tmp_path / "ours", ["backbone=tiny"], asset="droid")
