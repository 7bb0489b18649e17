"""What the leaderboard asks for beside the table: how the policy was trained and evaluated, as far as runs tell."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mme_vla.evaluation.results.aggregate import Method
from mme_vla.evaluation.store import RUN_FILE, read_run
from mme_vla.utils.pages import render

UNKNOWN = "not recorded with these results: state it manually"
RECIPE = {
    "steps": "updates", "batch_size": "samples an update", "lr": "peak learning rate", "warmup": "warm-up updates",
    "ema": "decay of the averaged weights", "weight_decay": "weight decay",
}  # fmt: skip
"""Settings of a training worth stating, and what they are called."""


def policy_facts(config: Mapping[str, Any]) -> dict[str, Any]:
    """What a policy's configuration tells of it and of its training, for the notes of a run."""
    card = config.get("card")
    card = card if isinstance(card, Mapping) else {}
    parts = {part: _section(config.get(part)) for part in ("memory", "integration")}
    return {**parts, "data": card.get("data"), "recipe": card.get("recipe")}


def read_runs(records: Iterable[Path]) -> list[dict[str, Any]]:
    """The `run.json` beside files of records, each once; records without one are passed over."""
    folders = dict.fromkeys(path.parent for path in records)
    return [read_run(folder) for folder in folders if (folder / RUN_FILE).is_file()]


def training_details(methods: Sequence[Method], runs: Sequence[Mapping[str, Any]]) -> str:
    """The section `Training details` of a submission, in Markdown."""
    policies = []
    for method in methods:
        for checkpoint in dict.fromkeys(run.key.checkpoint for run in method.runs):
            about = [
                run for run in runs
                if (run["settings"].get("model"), run["settings"].get("checkpoint")) == (method.model, checkpoint)
                and method.composition in ((run.get("notes") or {}).get("composition"), None)
            ]  # fmt: skip
            facts = next((run["notes"]["policy"] for run in about if (run.get("notes") or {}).get("policy")), None)
            seeds = sorted({run.key.model_seed for run in method.runs if run.key.checkpoint == checkpoint})
            record = next(r for run in method.runs if run.key.checkpoint == checkpoint for r in run.records.values())
            evaluation = (
                f"split {record.split}, {record.action_space} actions, at most {record.max_steps} steps, "
                f"model seeds {', '.join(map(str, seeds))}"
            )
            title = f"{method.label}, checkpoint {checkpoint}"
            policies.append({"title": title, "facts": [*_lines(facts), ("evaluation", evaluation)]})
    return render("training.md", policies=policies)


def _lines(facts: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    if facts is None:
        return [("policy", UNKNOWN), ("training", UNKNOWN)]
    memory, integration, recipe = facts.get("memory"), facts.get("integration"), facts.get("recipe")
    memory, integration = _section(memory), _section(integration)
    policy = f"memory {memory.get('name', 'without a name')}" if memory else "no memory"
    if memory and memory.get("budget") is not None:
        policy += f", {_text(memory['budget'])} tokens"
    if integration:
        policy += f", integration {integration.get('name', 'without a name')}"
    if not recipe:
        return [("policy", policy), ("training", UNKNOWN)]
    settings = _settings(recipe) if isinstance(recipe, Mapping) else str(recipe)
    return [("policy", policy), ("data", str(facts.get("data") or UNKNOWN)), ("training", settings)]


def _settings(recipe: Mapping[str, Any]) -> str:
    stated = (f"{words} {_text(recipe[name])}" for name, words in RECIPE.items() if recipe.get(name) is not None)
    return ", ".join(stated) or UNKNOWN


def _section(value: Any) -> dict[str, Any] | None:
    """A part of the configuration; one that is a word alone is its name."""
    if not value:
        return None
    return dict(value) if isinstance(value, Mapping) else {"name": str(value)}


def _text(value: Any) -> str:
    """A number in its shortest form; anything else (YAML reads `1e-4` as text) as it is."""
    return f"{value:g}" if isinstance(value, int | float) else str(value)
