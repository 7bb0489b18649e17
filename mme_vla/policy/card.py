"""The model card that lies beside saved weights: what the policy is, and what is known of its
training.
"""

from collections.abc import Mapping
from typing import Any

from torch import nn

from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import brief, require

CARD_FILE = "README.md"


def model_card(policy: nn.Module, config: Mapping[str, Any]) -> str:
    """Write a card from a policy's configuration.

    Its section `card` may hold `data` (words), `recipe` and `results` (name → value); what is
    absent is said to be. For the hub's front matter also `license`, `base_model` and `datasets`
    (ids on the hub).

    Raises:
        UserError: `recipe` or `results` is no mapping.
    """
    name, known = str(config.get("name", "policy")), config.get("card") or {}
    for key in ("recipe", "results"):
        value = known.get(key) or {}
        require(
            isinstance(value, Mapping),
            f"card[{key!r}]={brief(value)} must map names to values, such as {{'success (%)':"
            " 54.0}.",
        )
    backbone = config.get("backbone") or {}
    rows = {
        "memory": _part(config.get("memory")),
        "integration": _part(config.get("integration")),
        "backbone": (
            backbone.get("name", "pi05")
            + (f", {backbone['depth']} layers" if "depth" in backbone else "")
        ),
        "robot": str((config.get("embodiment") or {}).get("name", "robomme_joint")),
        "action chunk": (
            f"{backbone.get('horizon', '?')} steps of {backbone.get('action_dim', '?')} numbers"
        ),
        "parameters": f"{sum(p.numel() for p in policy.parameters()) / 1e6:.1f} M",
    }
    if config.get("adapters"):
        rows["adapters"] = f"LoRA, rank {config['adapters'].get('rank')}, not merged"
    return "\n".join(
        [
            "---",
            front_matter(name, known),
            "---",
            "",
            f"# {name}",
            "",
            f"A policy of the MME-VLA library (`{type(policy).__name__}`)"
            + (" with a memory of the episode." if config.get("memory") else " without memory."),
            "",
            *_table(rows),
            "",
            "## Use",
            "",
            "```python",
            *example(config),
            "```",
            "",
            "## Data",
            "",
            str(known.get("data") or "Not recorded."),
            "",
            "## Recipe",
            "",
            *(_table(known["recipe"]) if known.get("recipe") else ["Not recorded."]),
            "",
            "## Results",
            "",
            *(_table(known["results"]) if known.get("results") else ["Not recorded."]),
            "",
        ]
    )


def example(config: Mapping[str, Any]) -> list[str]:
    """Lines of Python from the weights to an action, with grey frames for the user's own."""
    robot = embodiment_of(config)
    frames = {camera.name: "frame" for camera in robot.cameras}
    lines = ["frame = np.full((1, 256, 256, 3), 127, np.uint8)  # yours, of each camera"]
    if robot.readings:
        lines += [
            "depth = np.full((1, 256, 256, 1), 500, np.int16)  # in millimetres",
            (
                "pose = np.eye(3, 4, dtype=np.float32)[None]  # from the world to the camera, in"
                " OpenCV's axes"
            ),
        ]
        frames |= {name: "depth" if name.endswith("_depth") else "pose" for name in robot.readings}
    options: list[str] = []
    if robot.action.choice:
        options = [
            'episode.options = [Option("a", "press the button")]  # those of the environment'
        ]
    return [
        "import numpy as np",
        "from mme_vla import Policy",
        *(["from mme_vla.embodiment.action_space import Option"] if options else []),
        "",
        'policy = Policy.from_pretrained("<this repository or folder>")',
        'episode = policy.start_episode("the goal in words", seed=7)',
        *options,
        *lines,
        f"frames = {{{', '.join(f'"{name}": {value}' for name, value in frames.items())}}}",
        (
            f"episode.observe(frames, np.zeros((1, {robot.state.width}), np.float32))  # and the"
            " robot's state"
        ),
        "chunk = policy.act(episode)  # the next actions",
    ]


def front_matter(name: str, known: Mapping[str, Any]) -> str:
    """What the hub reads of a card, as YAML: written by its own library, so that `no` or
    `2026-11-21` stay names.

    Numbers among the results, such as success rates, become its model index.
    """
    from huggingface_hub import EvalResult, ModelCardData

    numbers = {
        str(key): float(value)
        for key, value in (known.get("results") or {}).items()
        if isinstance(value, int | float) and not isinstance(value, bool)
    }
    results = [
        EvalResult(
            task_type="robotics",
            dataset_type="robomme",
            dataset_name="RoboMME",
            metric_type=key,
            metric_value=value,
        )
        for key, value in numbers.items()
    ]
    data = ModelCardData(
        library_name="mme-vla",
        pipeline_tag="robotics",
        tags=["robotics", "vision-language-action", "memory", name],
        license=known.get("license"),
        base_model=known.get("base_model"),
        datasets=known.get("datasets"),
        model_name=name if results else None,
        eval_results=results or None,
    )
    return data.to_yaml().strip()


def _part(section: Mapping[str, Any] | None) -> str:
    if not section or section.get("name") in (None, "none"):
        return "none"
    options = ", ".join(
        f"{key} {value}" for key, value in section.items() if key != "name" and value is not None
    )
    return f"{section['name']} ({options})" if options else str(section["name"])


def _table(rows: Mapping[str, Any]) -> list[str]:
    return ["| | |", "|---|---|", *(f"| {key} | {_cell(value)} |" for key, value in rows.items())]


def _cell(value: Any) -> str:
    return str(value).replace("|", "\\|").replace("\n", " ")
