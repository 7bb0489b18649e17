"""Exported π0.5 in LeRobot's own pipelines: the words, the numbers and the actions are the
policy's.
"""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from helpers.lerobot_pi05 import reduce_sizes
from mme_vla import build_policy
from mme_vla.cli.weights import convert
from mme_vla.embodiment import ActionSpace
from mme_vla.errors import UserError
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.tokenizer import PALIGEMMA, Tokenizer
from mme_vla.testing.small import moving_frames, small_policy
from mme_vla.weights.load import load_weights, transfer
from mme_vla.weights.ports import to_lerobot
from mme_vla.weights.writers import check_target

GOAL = "pick up the red cube"


def exportable() -> MMEPolicy:
    """A small policy that says it reads PaliGemma's tokenizer, which nothing here fetches."""
    policy = small_policy("pi05", backbone={"num_heads": 8})
    policy.config["processor"]["tokenizer"] = PALIGEMMA
    return policy


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """LeRobot's tokenizers come from the hub; here the shipped one means whatever is asked for."""
    import lerobot.processor.tokenizer_processor as lerobot_tokenizers

    names: list[str] = []
    sample_tokenizer = Tokenizer.load("sample")

    def tokenize(texts: list[str], max_length: int, **_: Any) -> dict[str, torch.Tensor]:
        ids = torch.zeros(len(texts), max_length, dtype=torch.int64)
        mask = torch.zeros_like(ids)
        for i, text in enumerate(texts):
            # PaliGemma's newline is a piece of its own; the small tokenizer has to be told so.
            encoded = sample_tokenizer.encode(text.removesuffix("\n")) + sample_tokenizer.encode(
                "\n", bos=False
            ) * text.endswith("\n")
            ids[i, : len(encoded)], mask[i, : len(encoded)] = torch.tensor(encoded), 1
        return {"input_ids": ids, "attention_mask": mask}

    def load(name: str) -> Any:
        names.append(name)
        return tokenize

    monkeypatch.setattr(lerobot_tokenizers, "AutoTokenizer", SimpleNamespace(from_pretrained=load))
    return names


@torch.no_grad()
def test_lerobots_pipelines_and_policy_give_our_actions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fetched: list[str]
) -> None:
    policy = exportable()
    lerobot_module = reduce_sizes(monkeypatch, policy.backbone.config)
    from lerobot.policies import make_pre_post_processors

    policy.save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "lerobot", to="lerobot")
    config = lerobot_module.PreTrainedConfig.from_pretrained(tmp_path / "lerobot")
    config.device = "cpu"
    loaded = lerobot_module.PI05Policy.from_pretrained(tmp_path / "lerobot", config=config).eval()
    before, after = make_pre_post_processors(config, pretrained_path=str(tmp_path / "lerobot"))
    assert fetched == ["google/paligemma-3b-pt-224"]
    assert config.n_action_steps == 1  # LeRobot's loop cannot anchor later ones

    # at another one the two libraries resize a little differently
    size = policy.backbone.image_size
    frames, state = moving_frames(2, size), np.linspace(-0.4, 0.4, 8, dtype=np.float32)
    episode = policy.start_episode(GOAL, seed=4)
    episode.observe({"front": frames[:1], "wrist": frames[1:]}, state[None])
    expected = policy.act(episode)
    noise = policy.start_episode(GOAL, seed=4).draw()["noise"]
    views = torch.from_numpy(frames).permute(0, 3, 1, 2) / 255
    names = ("observation.images.image", "observation.images.wrist_image")
    inputs = before(
        {
            **dict(zip(names, views.split(1), strict=True)),
            "observation.state": torch.from_numpy(state)[None],
            "task": [GOAL],
        }
    )
    chunk = after(loaded.predict_action_chunk(inputs, noise=noise[None]))
    assert np.abs(expected - state).max() > 0.1
    np.testing.assert_allclose(chunk[0].numpy(), expected, atol=2e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"tokenizer": "sample"}, "is none that LeRobot could fetch"),
        ({"prompt": "state"}, "no step that writes"),
    ],
)
def test_what_lerobot_has_no_step_for_is_reported(
    tmp_path: Path, changes: dict[str, str], message: str
) -> None:
    policy = exportable()
    policy.config["processor"] |= changes
    if "prompt" in changes:
        policy.require_processor().prompt_name = changes["prompt"]  # type: ignore[attr-defined]
    policy.save_pretrained(tmp_path / "ours")
    with pytest.warns(UserWarning, match=message):
        convert(tmp_path / "ours", tmp_path / "lerobot", to="lerobot")
    assert not (tmp_path / "lerobot/policy_preprocessor.json").exists()
    assert json.loads((tmp_path / "lerobot/config.json").read_text())["type"] == "pi05"


ARM = """
name: arm
cameras:
  head: {key: observation.images.head-cam_A}
  hand: {key: hand-cam}
state: {width: 4}
action: {width: 4, names: [lift, reach, twist, grip], relative: [0, 1, 2], horizon: 20}
"""


def test_a_camera_keeps_the_name_of_its_column(tmp_path: Path) -> None:
    (tmp_path / "embodiment").mkdir()
    (tmp_path / "embodiment/arm.yaml").write_text(ARM)
    policy = build_policy("pi05", config_dir=tmp_path, embodiment="arm")
    policy.save_pretrained(tmp_path / "ours")
    with pytest.warns(UserWarning, match="no normalisation statistics"):
        convert(tmp_path / "ours", tmp_path / "lerobot", to="lerobot")
    about = json.loads((tmp_path / "lerobot/config.json").read_text())
    assert list(about["input_features"]) == [
        "observation.images.head-cam_A",
        "observation.images.hand-cam",
        "observation.state",
    ]
    assert about["relative_exclude_joints"] == ["grip"]


@pytest.mark.parametrize(
    ("names", "relative", "mistaken"),
    [
        (["lift", "lift_gripper", "twist", "arm"], (1, 2, 3), "number 1, 'lift_gripper'"),
        (["LIFT", "twist_lift", "arm"], (1, 2), "number 1, 'twist_lift'"),
        (["lift", "lift_gripper", "arm"], (0, 2), None),
        ([f"number {i + 1}" for i in range(14)], tuple(range(1, 14)), "number 9, 'number 10'"),
        ([f"number {i + 1}" for i in range(14)], tuple(range(13)), None),
        (["lift", ""], (0,), "number 1, ''"),
        (["lift", "lift_gripper"], (0, 1), None),
        (["lift", "lift_gripper"], (), None),
    ],
)
def test_names_by_which_lerobot_mistakes_numbers_are_refused(
    names: list[str], relative: tuple[int, ...], mistaken: str | None
) -> None:
    from lerobot.processor import RelativeActionsProcessorStep

    action = ActionSpace(width=len(names), names=tuple(names), relative=relative)
    policy: Any = SimpleNamespace(memory=None, embodiment=SimpleNamespace(action=action))
    absolute = [name for i, name in enumerate(names) if i not in relative]
    mask = RelativeActionsProcessorStep(True, absolute, names)._build_mask(len(names))
    is_mistaken = bool(relative) and mask != [i in relative for i in range(len(names))]
    assert is_mistaken == (mistaken is not None)
    if mistaken is None:
        check_target(policy, "lerobot")
    else:
        with pytest.raises(UserError, match=rf"{mistaken}.*embodiment\.action\.names"):
            check_target(policy, "lerobot")


@pytest.mark.parametrize("setting", ["use_visual_memory", "use_proprioceptive_memory"])
def test_lerobots_short_window_memory_is_named_and_its_weights_are_a_start(
    tmp_path: Path, setting: str
) -> None:
    policy = small_policy("pi05")
    tensors = {
        name: tensor.clone() for name, tensor in to_lerobot(policy, policy.state_dict()).items()
    }
    if setting == "use_proprioceptive_memory":
        tensors["model.proprio_history_proj.weight"] = torch.ones(8, 32)
        tensors["model.proprio_history_proj.bias"] = torch.ones(8)
    save_file(tensors, tmp_path / "model.safetensors")
    about = {"type": "pi05", setting: True, "memory_frames": 6, "memory_stride": 10}
    (tmp_path / "config.json").write_text(json.dumps(about))
    with pytest.raises(UserError, match=r"short-window memory: memory_frames=6.*init_from"):
        load_weights(small_policy("pi05", seed=1), tmp_path)
    fresh = small_policy("framesamp_modul", seed=1)
    start = transfer(fresh, tmp_path)
    assert start.left == sorted(
        name.removeprefix("model.") for name in tensors if "proprio_history_proj" in name
    )
    original, loaded = policy.state_dict(), fresh.state_dict()
    assert all(torch.equal(loaded[name], tensor) for name, tensor in original.items())
