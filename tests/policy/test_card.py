"""The model card as the hub reads it."""

import re
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import ModelCard

from mme_vla import UserError
from mme_vla.policy.build import build_policy
from mme_vla.policy.card import model_card
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.run_folders import find_run, shipped_checkpoints
from mme_vla.testing.small import small_policy, unit_stats


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return small_policy("pi05")


@pytest.mark.parametrize(
    "name", ["no", "null", "2026-11-21", "my: model", "- x", "framesamp_modul", "1e3"]
)
def test_every_name_stays_a_name(policy: MMEPolicy, name: str) -> None:
    data = ModelCard(model_card(policy, {**policy.config, "name": name})).data
    assert data.tags[-1] == name and isinstance(data.tags[-1], str)
    assert (data.library_name, data.pipeline_tag) == ("mme-vla", "robotics")
    assert data.license is None and data.eval_results is None


def test_a_card_states_the_numbers_of_an_action_and_not_of_the_network(policy: MMEPolicy) -> None:
    space = policy.embodiment.action
    assert policy.config["backbone"]["action_dim"] > space.width
    stated = f"| action chunk | {space.horizon} steps of {space.width} numbers |"
    assert stated in model_card(policy, policy.config)


def test_licence_origin_data_and_results_are_reported(policy: MMEPolicy) -> None:
    known = {
        "license": "apache-2.0",
        "base_model": "lerobot/pi05_base",
        "datasets": ["lerobot/robomme"],
        "results": {"success_rate": 0.25, "note": "one seed"},
    }
    card = ModelCard(model_card(policy, {**policy.config, "card": known}))
    assert (card.data.license, card.data.base_model) == ("apache-2.0", "lerobot/pi05_base")
    assert card.data.datasets == ["lerobot/robomme"]
    assert [(r.metric_type, r.metric_value) for r in card.data.eval_results] == [
        ("success_rate", 0.25)
    ]
    assert "| note | one seed |" in card.text


@pytest.mark.parametrize(
    ("model", "settings"),
    [
        ("pi05", {}),
        ("framesamp_modul", {}),
        ("pi05", {"embodiment": "robomme_choice"}),
        ("sam2act_plus", {"backbone": "sam2act_tiny"}),
    ],
)
def test_the_example_of_a_card_runs_to_an_action(
    model: str, settings: dict, tmp_path: Path
) -> None:
    """Of robots that choose among options and that read depth as well."""
    saved = build_policy(model, **{"backbone": "tiny", **settings})
    saved.require_processor().stats = unit_stats(saved.embodiment)
    saved.save_pretrained(tmp_path)
    (block,) = re.findall(r"```python\n(.*?)```", (tmp_path / "README.md").read_text(), re.DOTALL)
    space: dict = {}
    exec(block.replace("<this repository or folder>", str(tmp_path)), space)
    assert space["chunk"].shape[-1] == saved.embodiment.action.width


@pytest.mark.parametrize("name", shipped_checkpoints())
def test_the_example_of_a_shipped_card_runs_to_an_action(name: str) -> None:
    card = (find_run(Path(name)) / "README.md").read_text()
    (block,) = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    space: dict = {}
    exec(block, space)
    action = space["policy"].embodiment.action
    assert f"| {action.horizon} steps of {action.width} numbers |" in card
    assert np.isfinite(space.get("chunk", space.get("choice"))).all()


@pytest.mark.parametrize("key", ["recipe", "results"])
def test_a_table_of_a_card_that_is_a_text_is_refused(policy: MMEPolicy, key: str) -> None:
    with pytest.raises(UserError, match=rf"card\['{key}'\]='54 %' must map names to values"):
        model_card(policy, {**policy.config, "card": {key: "54 %"}})


@pytest.mark.parametrize("card", [None, [], False, {}])
def test_an_empty_card_is_saved_as_none(policy: MMEPolicy, card: object) -> None:
    assert "Not recorded." in model_card(policy, {**policy.config, "card": card})


def test_a_card_that_is_no_section_is_refused_by_name(policy: MMEPolicy) -> None:
    with pytest.raises(UserError, match=r"card=\['words'\] must be a section of keys"):
        model_card(policy, {**policy.config, "card": ["words"]})


def test_a_part_without_a_name_is_none_in_the_card(policy: MMEPolicy) -> None:
    memory = {"name": "none", "views": True}
    assert "| memory | none |" in model_card(policy, {**policy.config, "memory": memory})
