"""One object takes raw data to the network and back, and comes out of its folder unchanged."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.errors import UserError
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.processing.processor import Processor
from mme_vla.processing.tokenizer import Tokenizer


def stats(dims: int = 8) -> NormStats:
    rng = np.random.default_rng(5)
    low = rng.normal(size=(2, dims))
    one, two = (QuantileStats(x + 0.5, np.ones(dims), x, x + 1.0) for x in low)
    return NormStats(state=one, actions=two)


def processor(**changes) -> Processor:
    settings = {
        "image_size": 28,
        "tokenizer": Tokenizer.load("sample"),
        "prompt_length": 32,
        "embodiment": ROBOMME_JOINT.with_horizon(5),
    }
    return Processor(**{**settings, "stats": stats(), **changes})


def frames(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)


def test_current_views_become_one_channel_first_tensor() -> None:
    front, wrist = frames(40, 60), frames(56, 56)
    images = processor().images([front, wrist])
    assert images.shape == (2, 3, 28, 28) and images.dtype == torch.uint8 and images.is_contiguous()
    many = processor().images([np.stack([front, front]), np.stack([wrist, wrist])])
    assert many.shape == (2, 2, 3, 28, 28)
    assert torch.equal(many[1], images)


def test_memory_frames_become_unit_range_floats_also_from_read_only_arrays() -> None:
    array = frames(4, 48, 48)
    array.flags.writeable = False
    pixels = processor().memory_images(array, "cpu")
    assert pixels.shape == (4, 3, 28, 28) and pixels.dtype == torch.float32
    assert pixels.min() >= -1 and pixels.max() <= 1
    assert torch.equal(pixels, processor().memory_images(torch.tensor(array)))


def test_actions_come_back_after_a_detour_through_the_network_form() -> None:
    rng = np.random.default_rng(1)
    chunk, state = rng.normal(size=(5, 8)), rng.normal(size=8).astype(np.float32)
    actions = processor().actions(chunk, state)
    assert actions.shape == (5, 32) and actions.dtype == torch.float32 and not actions[:, 8:].any()
    back = processor().absolute_actions(actions[None], torch.tensor(state)[None])
    assert back.shape == (1, 5, 8)
    assert np.allclose(back[0].numpy(), chunk, atol=1e-5)


def test_prompt_state_is_normalised_before_it_is_saved() -> None:
    proc = processor(prompt="state", prompt_length=64)
    ids, mask = proc.prompt("press it", state=stats().state.q01)
    text = proc.tokenizer.decode(ids[mask].tolist())
    assert text == "Task: press it; State: 0 0 0 0 0 0 0 0;\nAction: "


def test_prompt_takes_what_its_format_needs_and_ignores_the_remainder() -> None:
    unprompted, subgoal = processor(stats=None), processor(prompt="subgoal", stats=None)
    assert torch.equal(
        unprompted.prompt("press it", "put it down", np.zeros(8))[0],
        unprompted.prompt("press it")[0],
    )
    ids, mask = subgoal.prompt("press it", "put it down")
    assert "Current Subgoal: put it down" in subgoal.tokenizer.decode(ids[mask].tolist())


@pytest.mark.parametrize("with_stats", [True, False])
def test_processor_comes_out_of_its_folder_unchanged(tmp_path: Path, with_stats: bool) -> None:
    saved = processor(
        prompt="subgoal", embodiment=ROBOMME_JOINT, stats=stats() if with_stats else None
    )
    saved.save(tmp_path)
    loaded = Processor.load(tmp_path)
    assert loaded.to_config() == saved.to_config()
    assert loaded.embodiment == saved.embodiment and loaded.prompt_name == "subgoal"
    assert (loaded.stats and loaded.stats.to_dict()) == (saved.stats and saved.stats.to_dict())
    assert torch.equal(loaded.prompt("a", "b")[0], saved.prompt("a", "b")[0])


def test_config_names_a_tokenizer_and_statistics_by_path(tmp_path: Path) -> None:
    stats().save(tmp_path / "mine.json")
    built = Processor.from_config(
        {
            "image_size": 56,
            "tokenizer": "sample",
            "stats": str(tmp_path / "mine.json"),
            "embodiment": ROBOMME_JOINT.with_horizon(10).to_dict(),
        }
    )
    assert (
        built.stats is not None
        and built.embodiment.action.horizon == 10
        and built.prompt_length == 64
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prompt": "subgaol"}, "Did you mean 'subgoal'"),
        ({"prompt_lenght": 3}, "Did you mean 'prompt_length'"),
        ({"image_size": "224"}, "image_size must be a positive"),
        ({"embodiment": {"name": "mine"}}, "embodiment lacks the key 'cameras'"),
        ({"stats": "nowhere.json"}, "nowhere.json"),
        ({"tokenizer": "nowhere.model"}, "nowhere.model"),
        ({"tokenizer_fingerprint": "0123"}, "fingerprint"),
    ],
)
def test_impossible_settings_are_refused(change: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        Processor.from_config(
            {
                "image_size": 28,
                "tokenizer": "sample",
                "embodiment": ROBOMME_JOINT.to_dict(),
                **change,
            }
        )


def test_settings_without_a_tokenizer_are_refused() -> None:
    with pytest.raises(UserError, match="lack 'tokenizer'"):
        Processor.from_config({"image_size": 28})


def test_states_and_actions_need_statistics() -> None:
    bare = processor(stats=None, prompt="state")
    with pytest.raises(UserError, match=r"'mine\.json' must be a NormStats: NormStats\.load"):
        bare.stats = "mine.json"
    with pytest.raises(UserError, match=r"norm_stats\.json"):
        bare.actions(np.zeros((5, 8)), np.zeros(8))
    with pytest.raises(UserError, match=r"norm_stats\.json"):
        bare.absolute_actions(torch.zeros(5, 32), torch.zeros(8))
    with pytest.raises(UserError, match=r"norm_stats\.json"):
        bare.prompt("press it", state=np.zeros(8))


def test_shapes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UserError, match=r"\[5, 8\].*\[4, 8\]"):
        processor().actions(np.zeros((4, 8)), np.zeros(8))
    with pytest.raises(UserError, match="action_dim=4"):
        processor(action_dim=4)
    with pytest.raises(UserError, match="Expected 2 views"):
        processor().images([frames(8, 8)])
    with pytest.raises(UserError, match="as many images"):
        processor().images([frames(8, 8), frames(2, 8, 8)])


def test_a_folder_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"No processor\.json"):
        Processor.load(tmp_path)
    (tmp_path / "processor.json").write_text("{")
    with pytest.raises(UserError, match="not valid JSON"):
        Processor.load(tmp_path)
    (tmp_path / "processor.json").write_text(json.dumps([1]))
    with pytest.raises(UserError, match="must hold an object"):
        Processor.load(tmp_path)
