"""What `mme-vla inspect checkpoint=…` prints: a policy, its training and its statistics."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mme_vla.data.recording import action_offset_of
from mme_vla.data.sources import listed_sources
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.action_space import numbered
from mme_vla.errors import counted, printable
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import STATE, resolve_checkpoint
from mme_vla.policy.sections import PolicySections
from mme_vla.training.checkpoint import read_state


def show_checkpoint(
    folder: Path, console: Console, trust_plugins: bool = False, everything: bool = False
) -> None:
    """Print a summary of a checkpoint: robot, memory, budget, data, steps and error.

    Args:
        folder: of a checkpoint or a run.
        trust_plugins: import the modules that the checkpoint names.
        everything: print its whole configuration and its statistics too.
    """
    folder = resolve_checkpoint(folder)
    policy = Policy.from_pretrained(folder, trust_plugins=trust_plugins)
    console.print(str(folder), style="bold", highlight=False, soft_wrap=True)
    state = read_state(folder) if (folder / STATE).is_file() else None
    grid = Table.grid(padding=(0, 2))
    for row in [*summary_rows(policy), *training_rows(policy, state)]:
        grid.add_row(*map(printable, row))
    console.print(grid, highlight=False)
    if everything:
        show_details(policy, state, console)
    else:
        console.print("all=true shows the whole configuration and the statistics", style="dim")


def summary_rows(policy: Policy) -> list[tuple[str, str]]:
    """What a policy is, a title and a text each."""
    sections = PolicySections.of(policy.config)
    robot = policy.embodiment
    space = robot.action
    parts: dict[str, int] = {}
    dtypes: dict[str, None] = {}  # in order, each once
    for name, parameter in policy.named_parameters():
        part = policy.finetune_spec.component_of(name)
        parts[part] = parts.get(part, 0) + parameter.numel()
        dtypes[str(parameter.dtype).removeprefix("torch.")] = None
    sizes = ", ".join(f"{part} {count:,}" for part, count in parts.items())
    names = [str(sections.name or "policy"), str(sections.backbone.get("name", "pi05"))]
    rate = "any rate" if robot.fps is None else f"{robot.fps:g} frames per second"
    relative = f"{len(space.relative)} of them relative to the state"
    if space.of_pose:
        relative = f"{len(space.of_pose)} of them differences to the tool's pose"
    memory = "none"
    if policy.memory is not None:
        budget = counted(policy.memory.budget, "token") if policy.memory.budget else "no tokens"
        parts_of = [str(sections.memory.get("name", "memory")), budget]
        parts_of.append(f"of the camera {robot.memory_camera}")
        parts_of.append(f"integration {sections.integration.get('name', 'none')}")
        memory = ", ".join(parts_of)
    return [
        ("model", f"{names[0]}, backbone {names[1]} ({type(policy).__name__})"),
        ("parameters", f"{sum(parts.values()):,} ({', '.join(dtypes)}): {sizes}"),
        ("robot", f"{robot.name}: cameras {', '.join(robot.camera_names)}, {rate}"),
        ("state", counted(robot.state.width, "number")),
        ("action", f"{counted(space.width, 'number')}, {relative}"),
        ("chunk", f"{space.horizon} actions, of which {space.execute} are executed"),
        ("memory", memory),
        ("text", policy.require_processor().prompt_spec.encoder),
    ]


def training_rows(policy: Policy, state: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """What is known of a checkpoint's training: data, steps, and error.

    state: of the training, where the checkpoint has it.
    """
    card = PolicySections.of(policy.config).card
    known = str(card.get("data") or "not recorded")
    steps = _summary(card.get("recipe") or "not recorded")
    if state is not None:
        data = state["config"].get("data", {})
        train = state["config"].get("train", {})
        known = ", ".join(entry.short_name for entry in listed_sources(data.get("sources")))
        steps = f"{state['step']:,} of {train.get('steps', 0):,} updates"
        steps += f", batches of {train.get('batch_size')}, learning rate {train.get('lr')}"
        steps += f", seed {state['config'].get('seed')}"
    if action_offset_of(policy):
        known += f", action_offset={action_offset_of(policy)}"
    error = _summary(card.get("results") or "not recorded")
    error += "; mme-vla inspect checkpoint=… dataset=… compares actions"
    return [("data", known), ("training", steps), ("error", error)]


def show_details(policy: Policy, state: Mapping[str, Any] | None, console: Console) -> None:
    """Print a checkpoint's whole configuration, training state and statistics."""
    settings = titled_table("configuration", "section", "values")
    for name, section in policy.config.items():
        settings.add_row(name, _summary(section))
    if state is not None:
        settings.add_row(
            "trained for",
            f"{counted(state['step'], 'step')}; weights here are averages, raw ones beside them",
        )
        settings.add_row("recipe", _summary(state["config"].get("train", {})))
        settings.add_row("data", _summary(state["config"].get("data", {})))
        settings.add_row("versions", _summary(state["versions"]))
    print_table(settings, console)
    stats = policy.require_processor().stats
    if stats is not None:
        space = policy.embodiment.action
        action = "action delta" if space.relative or space.of_pose else "action"
        for title, of, names in (
            ("state", stats.state, state_names(policy.embodiment)),
            (action, stats.actions, space.names),
        ):
            # Extremes are kept where a policy normalises by them.
            bounds = {}
            for bound in ("min", "q01", "q99", "max"):
                if getattr(of, bound) is not None:
                    bounds[bound] = getattr(of, bound)
            numbers = titled_table(f"normalisation of the {title}", "number", *bounds)
            for i, name in enumerate(names):
                numbers.add_row(name, *(f"{values[i]:.3f}" for values in bounds.values()))
            print_table(numbers, console)


def state_names(robot: Embodiment) -> tuple[str, ...]:
    """Names of the state's numbers: the action's where an action is relative to them."""
    names = list(numbered(robot.state.width))
    for place in robot.action.relative:
        names[place] = robot.action.names[place]
    return tuple(names)


def titled_table(title: str, *columns: str) -> Table:
    """A table whose first column and texts are aligned left, and its numbers right."""
    table = Table(title=printable(title), show_header=any(columns))
    for i, column in enumerate(columns):
        table.add_column(
            column,
            justify="left" if i == 0 or column in ("goal", "values", "task", "") else "right",
        )
    return table


def print_table(table: Table, console: Console) -> None:
    """Print a table under its title, which may be wider: a path is not broken."""
    console.print(table.title, style="bold", markup=False, highlight=False, soft_wrap=True)
    table.title = None
    console.print(table)


def _summary(value: Any) -> str:
    if isinstance(value, dict):
        parts = []
        for key, inner in value.items():
            text = _summary(inner)
            parts.append(f"{key}={{{text}}}" if isinstance(inner, dict) else f"{key}={text}")
        return ", ".join(parts)
    return printable(str(value))
