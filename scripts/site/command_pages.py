"""One page for each command of `mme-vla`: purpose, guide, examples, and what `--help` lists."""

import io
import os
import sys
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module

import config_pages

from mme_vla.cli import commands
from mme_vla.cli import help as cli_help
from mme_vla.config.trees import library_files
from mme_vla.errors import UserError

GUIDES = {
    "train": "start/getting-started.md",
    "evaluate": "evaluate/evaluation.md",
    "results": "evaluate/results.md",
    "analyse": "probe/analyses.md",
    "audit": "evaluate/servers.md",
    "probe": "probe/probe.md",
    "inspect": "start/getting-started.md",
    "serve": "serve/serving.md",
    "harness": "serve/harness.md",
    "play": "evaluate/play.md",
    "convert": "train/data.md",
    "exec-starts": "train/data.md",
    "cache": "train/cache.md",
    "nano": "train/nano.md",
    "vision-pretrain": "train/nano.md",
    "record": "benchmark/record.md",
    "gallery": "benchmark/gallery.md",
    "weights": "train/weights.md",
    "subgoal-build": "train/subgoal-training.md",
    "subgoal-train": "train/subgoal-training.md",
    "sample": "train/data.md",
    "train-tokenizer": "train/data.md",
    "docs": "extend/contributing.md",
}
"""Command → the page that shows it at work."""
EXAMPLES = {
    "results": "mme-vla results --demo --html report.html",
    "analyse": "mme-vla analyse selection --output selection.mp4",
    "harness": "mme-vla harness --port 8000 --args.checkpoint=outputs/framesamp_modul/latest",
    "weights": (
        "mme-vla weights Yinpei/mme_vla_suite/perceptual-framesamp-modul"
        " checkpoints/framesamp_modul"
    ),
    "sample": "mme-vla sample datasets/full datasets/thinned",
    "train-tokenizer": "mme-vla train-tokenizer tokenizer",
    "docs": "mme-vla docs",
}
"""An example for each command that has no YAML file."""
WIDTH = 78
"""Columns of the help texts."""


def config_of(command: str) -> str | None:
    """The stem of the YAML file that configures a command; None where it takes options instead."""
    return commands()[command].config or None


def help_text(command: str) -> str:
    """What `mme-vla COMMAND --help` prints. Without the extra that the command needs: the error
    that names it.
    """
    before = sys.argv, os.environ.get("COLUMNS")
    sys.argv, os.environ["COLUMNS"] = [f"mme-vla {command}", "--help"], str(WIDTH)
    printed = io.StringIO()
    try:
        with redirect_stdout(printed), redirect_stderr(printed):
            import_module(commands()[command].module).main()
    except SystemExit:
        pass  # argparse ends so
    except UserError as error:
        return str(error)
    finally:
        sys.argv = before[0]
        os.environ.pop("COLUMNS") if before[1] is None else os.environ.update(COLUMNS=before[1])
    return printed.getvalue().rstrip()


def page(command: str) -> str:
    """The page of one command."""
    purpose = commands()[command].text
    guide = f"The [guide](../../{GUIDES[command]}) shows it at work."
    parts = [f"# `mme-vla {command}`"]
    stem = config_of(command)
    if stem is None:
        parts += [
            f"{purpose[0].upper()}{purpose[1:]}. {guide}",
            f"```bash\n{EXAMPLES[command]}\n```",
            f"## Options\n\n```text\n{help_text(command)}\n```",
        ]
        return "\n\n".join(parts) + "\n"
    file = library_files("")[stem]
    # The file's comment says what the command does; the table of commands where it has none.
    if not cli_help.heading(file)[1]:
        parts.append(f"{purpose[0].upper()}{purpose[1:]}.")
    introduction = config_pages.introduction(file)
    parts.append(introduction)
    if f"../../{GUIDES[command]}" not in introduction:
        parts.append(guide)
    parts.append(f"## Keys of [{file.name}]({config_pages.source_link(file)})")
    parts.append(config_pages.key_table(file))
    chosen = cli_help.defaults(file)
    if chosen.files:
        parts.append("Also the keys of " + ", ".join(included(name) for name in chosen.files) + ".")
    groups = {
        group: name
        for stem in [*chosen.files, stem]
        for group, name in cli_help.defaults(library_files("")[stem]).groups.items()
    }
    if groups:
        rows = [f"| {group_link(group)} | `{name}` |" for group, name in sorted(groups.items())]
        parts.append("\n".join(["## Groups", "", "| group | default |", "|---|---|", *rows]))
    return "\n\n".join(parts) + "\n"


def included(stem: str) -> str:
    """A link to the page with the keys of a YAML file that another one includes."""
    command = cli_help.configured_commands()[stem].split()[-1]
    if command in commands():
        return f"[`{command}`]({command}.md)"
    return f"[`{command}`](../configuration.md)"


def group_link(group: str) -> str:
    """A group's name, linked to the page of its files."""
    folder = group.strip("/").split("@")[0]
    return f"[`{group.strip('/')}`](../configuration/{folder}.md)"


def pages() -> dict[str, str]:
    """Path under `docs/` → Markdown, for every command.

    Raises:
        ValueError: a command has no guide, or no example.
    """
    examples = EXAMPLES.keys() | filter(config_of, commands())
    if missing := commands().keys() - (GUIDES.keys() & examples):
        raise ValueError(
            f"scripts/site/command_pages.py: no entry in GUIDES or EXAMPLES for {sorted(missing)}"
        )
    return {f"reference/commands/{command}.md": page(command) for command in commands()}
