"""Names and numbers that pages and comments state of the code."""

import csv
import inspect
import re
from pathlib import Path

import yaml

from helpers import REPOSITORY
from mme_vla import evaluate
from mme_vla.data.cache import default_cache_root
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.evaluation import default_output
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.memory.perturbation import _HOOKS, PROBE, TRAINING
from mme_vla.serving.client import LARGEST_REPLY
from mme_vla.subgoal.models.api import LONGEST_REPLY

DOCS = REPOSITORY / "docs"
CONFIGS = REPOSITORY / "configs"


def text_of(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def test_the_page_of_evaluation_names_the_keys_that_python_does_not_take() -> None:
    page = text_of(DOCS / "evaluate" / "evaluation.md")
    (stated,) = re.findall(r"keys of `evaluate.yaml`, without `([^`]*)`", page)
    content = yaml.safe_load(text_of(CONFIGS / "evaluate.yaml"))
    taken = {*inspect.signature(evaluate).parameters, *RolloutSettings.__annotations__}
    assert sorted(stated.split(", ")) == sorted({*content} - taken - {"defaults", "hydra"})


def test_the_folder_of_an_evaluation_is_stated_with_all_its_parts() -> None:
    facts = RunKey("pi05", 100, 7, split="ood", subgoal="oracle", memory_budget=64)
    folder = default_output(facts).as_posix()
    values = {"model": "pi05", "memory tokens": "64", "checkpoint": "100", "seed": "7"}
    values |= {"subgoal": "oracle", "split": "ood"}
    for stated in (CONFIGS / "evaluate.yaml", DOCS / "evaluate" / "evaluation.md"):
        (form,) = re.findall(r"outputs/evaluation/<model>\[.*<split>\]", text_of(stated))
        words = re.sub(r"[\[\]]", "", form)
        assert re.sub(r"<([a-z ]+)>", lambda match: values[match[1]], words) == folder


def test_the_page_of_events_lists_the_hooks_that_training_and_a_probe_call() -> None:
    page = text_of(DOCS / "probe" / "events.md")
    (row,) = re.findall(r"^\| hooks \|(.*)\|$", page, re.MULTILINE)
    training, _, probe = (re.findall(r"`(\w+)`", cell) for cell in row.split("|"))
    assert training == [*_HOOKS[TRAINING]]
    assert probe == [*_HOOKS[PROBE]]


def test_the_full_backbone_has_as_many_parameters_as_its_file_and_the_recipe_state() -> None:
    # `test_analyses.py` holds this table equal to the network.
    rows = csv.DictReader(text_of(REPOSITORY / "mme_vla" / "assets" / "cost.csv").splitlines())
    (billions,) = (int(row["parameters"]) / 1e9 for row in rows if row["model"] == "pi05")
    assert f"full size: {billions:.2f} B parameters" in text_of(CONFIGS / "backbone" / "pi05.yaml")
    assert f"the {billions:.1f} B-parameter backbone" in text_of(DOCS / "train" / "full-model.md")


def test_the_page_of_costs_states_the_counts_of_the_shipped_table() -> None:
    rows = csv.DictReader(text_of(REPOSITORY / "mme_vla" / "assets" / "cost.csv").splitlines())
    counts = {row["model"]: row for row in rows}
    page = text_of(DOCS / "evidence" / "cost.md")
    page = page.partition("## FLOPs")[2].partition("### Over the budget")[0]
    stated = re.findall(r"^\| `(\w+)` \|[^|]*\|([^|]*)\|([^|]*)\|([^|]*)\|", page, re.MULTILINE)
    assert len(stated) > 20
    for model, *cells in stated:
        row = counts[model]
        assert [cell.strip() for cell in cells] == [
            f"{int(row['parameters']) / 1e6:,.1f} M",
            f"{int(row['forward']) / 1e12:.3f} T",
            f"{int(row['chunk']) / 1e12:.3f} T",
        ], model


def test_files_of_data_name_the_folder_of_vision_caches() -> None:
    for name in ("sample", "robomme"):
        comment = f"null: `{default_cache_root().name}` in $MME_VLA_CACHE, else in"
        assert comment in text_of(CONFIGS / "data" / f"{name}.yaml")


def test_the_page_of_security_states_the_largest_replies() -> None:
    page = " ".join(text_of(REPOSITORY / "SECURITY.md").split())
    largest = f"limit replies to {LARGEST_REPLY / 2**20:g} MiB and {LONGEST_REPLY / 2**20:g} MiB"
    assert f"{largest}, and follow no redirect" in page
