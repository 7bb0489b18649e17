"""The model card that lies beside saved weights: what the policy is, and what is known of its
training.
"""

from collections.abc import Mapping
from typing import Any

from torch import nn

from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import brief, require
from mme_vla.policy.sections import PolicySections

CARD_FILE = "README.md"
_SELF_CHECK = """
## Self-check

`self_check.safetensors` holds a synthetic observation history, noise, and the chunk that this
policy predicted. `mme-vla inspect checkpoint=<this folder> check=true` compares.
"""


def model_card(policy: nn.Module, config: Mapping[str, Any], self_check: bool = False) -> str:
    """Write a card from a policy's configuration.

    Its section `card` may hold `data` (words), `recipe` and `results` (name → value); what is
    absent is said to be. For the hub's front matter also `license`, `base_model` and `datasets`
    (ids on the hub).

    Args:
        self_check: whether one lies beside the card.

    Raises:
        UserError: `recipe` or `results` is no mapping.
    """
    sections = PolicySections.of(config)
    name = str(sections.name or "policy")
    known = sections.card
    for key in ("recipe", "results"):
        value = known.get(key) or {}
        require(
            isinstance(value, Mapping),
            f"card[{key!r}]={brief(value)} must map names to values, such as {{'success (%)':"
            " 54.0}.",
        )
    network = sections.backbone.get("name", "pi05")
    if "depth" in sections.backbone:
        network += f", {sections.backbone['depth']} layers"
    robot = embodiment_of(config)
    rows = {
        "memory": _part(sections.memory),
        "integration": _part(sections.integration),
        "backbone": network,
        "robot": robot.name,
        "action chunk": f"{robot.action.horizon} steps of {robot.action.width} numbers",
        "parameters": f"{sum(p.numel() for p in policy.parameters()) / 1e6:.1f} M",
    }
    if sections.adapters:
        rows["adapters"] = f"LoRA, rank {sections.adapters.get('rank')}, not merged"
    check = _SELF_CHECK if self_check else ""
    memory = "with a memory of the episode" if sections.memory else "without memory"
    return f"""---
{front_matter(name, known)}
---

# {name}

A policy of the MME-VLA library (`{type(policy).__name__}`) {memory}.

{_table(rows)}

## Use

```python
{example(config)}
```
{check}
## Data

{known.get("data") or "Not recorded."}

## Recipe

{_table(known.get("recipe"))}

## Results

{_table(known.get("results"))}
"""


def example(config: Mapping[str, Any]) -> str:
    """Python from the weights to an action, with grey frames for the user's own."""
    robot = embodiment_of(config)
    imports = ["import numpy as np", "from mme_vla import Policy"]
    lines = [
        'policy = Policy.from_pretrained("<this repository or folder>")',
        'episode = policy.start_episode("the goal in words", seed=7)',
    ]
    if robot.action.choice:
        imports.append("from mme_vla.embodiment.action_space import Option")
        lines.append(
            'episode.options = [Option("a", "press the button")]  # those of the environment'
        )
    lines.append("frame = np.full((1, 256, 256, 3), 127, np.uint8)  # yours, of each camera")
    frames = [f'"{camera.name}": frame' for camera in robot.cameras]
    if robot.readings:
        lines.append("depth = np.full((1, 256, 256, 1), 500, np.int16)  # in millimetres")
        lines.append(
            "pose = np.eye(3, 4, dtype=np.float32)[None]  # from the world to the camera, in"
            " OpenCV's axes"
        )
    for name in robot.readings:
        frames.append(f'"{name}": depth' if name.endswith("_depth") else f'"{name}": pose')
    state = f"np.zeros((1, {robot.state.width}), np.float32)"
    lines.append(f"frames = {{{', '.join(frames)}}}")
    lines.append(f"episode.observe(frames, {state})  # and the robot's state")
    lines.append("chunk = policy.act(episode)  # the next actions")
    return "\n".join([*imports, "", *lines])


def front_matter(name: str, known: Mapping[str, Any]) -> str:
    """What the hub reads of a card, as YAML: written by its own library, so that `no` or
    `2026-11-21` stay names.

    Numbers among the results, such as success rates, become its model index.
    """
    from huggingface_hub import EvalResult, ModelCardData

    results = []
    for key, value in (known.get("results") or {}).items():
        if isinstance(value, int | float) and not isinstance(value, bool):
            result = EvalResult(
                task_type="robotics",
                dataset_type="robomme",
                dataset_name="RoboMME",
                metric_type=str(key),
                metric_value=float(value),
            )
            results.append(result)
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


def _part(section: Mapping[str, Any]) -> str:
    """A part's name with its options; a section without a name describes no part."""
    options = {key: value for key, value in section.items() if value is not None}
    name = str(options.pop("name", "none"))
    if name == "none" or not options:
        return name
    return f"{name} ({', '.join(f'{key} {value}' for key, value in options.items())})"


def _table(rows: Mapping[str, Any] | None) -> str:
    if not rows:
        return "Not recorded."
    lines = ["| | |", "|---|---|"]
    for key, value in rows.items():
        cell = str(value).replace("|", "\\|").replace("\n", " ")
        lines.append(f"| {key} | {cell} |")
    return "\n".join(lines)
