"""`python -m mme_vla.play tasks=… episodes=…`: play the tasks yourself, or let a model play
(configs/play.yaml).
"""

import logging
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from omegaconf import DictConfig

from mme_vla.cli.command import log_to_terminal
from mme_vla.config.composition import resolved
from mme_vla.config.sections import NonNegativeInt, PathText, PositiveInt, Range, read_section
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes, named_tasks
from mme_vla.envs.rendering import render_backend
from mme_vla.errors import UserError, counted, require
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.store import INDIFFERENT
from mme_vla.extras.play import build_player
from mme_vla.extras.play.desk import Desk
from mme_vla.extras.play.game import MAX_CHOICES, ChoiceSession
from mme_vla.extras.play.players import Player, play
from mme_vla.extras.play.run import Identity, PlayRun, make_session
from mme_vla.extras.play.web import require_page, serve

log = logging.getLogger("mme_vla.play")
HUMAN = "human"


@dataclass(frozen=True)
class PlaySettings:
    """The keys of `configs/play.yaml` that decide the outcomes, beside the player."""

    split: str
    env: str
    max_steps: PositiveInt
    max_choices: PositiveInt | None


@dataclass(frozen=True)
class PlayCommand:
    """The other keys of `configs/play.yaml`, where each is explained."""

    player: Mapping[str, Any]
    episodes: Any
    split: str
    env: str
    max_steps: PositiveInt | None
    retry_errors: bool
    output: PathText | None
    host: str
    port: Annotated[int, Range(0, 65535)]
    seed: NonNegativeInt
    checkpoint: PathText | None
    server: PathText | None

    @property
    def policy(self) -> str | None:
        """The words that name a policy which plays; None where a player of `player` does."""
        if self.checkpoint is None and self.server is None:
            return None
        return f"checkpoint={self.checkpoint}" if self.server is None else f"server={self.server}"


def main(cfg: DictConfig) -> None:
    """Play the episodes that are not played yet, on the page or by a model, and compare with the
    paper.
    """
    config = resolved(cfg)
    command = read_section(PlayCommand, config, others=True)
    log_to_terminal(log, clock=True)
    source = environment(command.env)
    specs = choose_episodes(named_tasks(config), command.episodes, command.split, command.env)
    max_steps = command.max_steps or source.step_limit(command.split)
    limits = {}
    if command.max_steps is None:
        limits = {spec.task: source.task_limit(spec.task, spec.split) for spec in specs}
    settings = read_section(PlaySettings, {**config, "max_steps": max_steps}, others=True)
    built, identity, folder = _choose_player(command, cfg, settings, limits)
    needs_images = built is None or built.needs_images
    source.check_installed()
    if command.env == "mme_vla" and needs_images:
        render_backend()
    make = partial(
        make_session,
        env=command.env,
        limit_of=identity.limit_of,
        max_choices=identity.settings["max_choices"],
        images=needs_images,
    )
    try:
        with PlayRun(folder, specs, identity, make, command.retry_errors) as run:
            if built is None:
                serve(Desk(run, str(identity.checkpoint)), command.host, command.port)
                played = len(run.episodes) - len(run.todo)
                of = f"{played} of {counted(len(run.episodes), 'episode')} played"
                log.info("ended · %s; the same command continues with the others", of)
            else:
                _by_itself(run, built)
            print_summary(run)
    finally:
        if built is not None:
            built.close()


def _choose_player(
    command: PlayCommand, cfg: DictConfig, settings: PlaySettings, limits: Mapping[str, int]
) -> tuple[Player | None, Identity, Path]:
    """Who plays (None: a person on the page), under which name, and the folder of the records."""
    kind = str(command.player["name"])
    folder = Path("outputs", "play", kind)
    model = HUMAN
    checkpoint: int | str = 0
    seed = command.player.get("seed", 0)
    decisive = {k: v for k, v in command.player.items() if k not in INDIFFERENT}
    of_policy = {}
    player: Player | None = None
    if command.policy is not None:
        require(
            kind == HUMAN, f"{command.policy} and player={kind} are two players: leave out one."
        )
        from mme_vla.extras.play.policy_player import load_player  # PyTorch

        player, facts, decisive = load_player(cfg, settings.max_steps, settings.max_choices)
        model, checkpoint, seed = player.model, facts.checkpoint, command.seed
        folder = Path("outputs", "play", model, str(checkpoint))
        for name in ("memory_budget", "composition", "training"):
            of_policy[name] = getattr(facts, name)
    elif kind == HUMAN:
        require_page()
        checkpoint = str(command.player["participant"])
    else:
        player = build_player(command.player)
        model = player.model
    if settings.max_choices is None:
        most = MAX_CHOICES if player is None else player.max_choices
        settings = replace(settings, max_choices=most)
    if command.output is not None:
        folder = Path(command.output).expanduser()
    identity = Identity(
        model,
        checkpoint,
        seed,
        settings.max_steps,
        {**asdict(settings), "player": decisive},
        limits,
        of_policy,
    )
    return player, identity, folder


def _by_itself(run: PlayRun, player: Any) -> None:
    """Play and record the episodes; what breaks in one ends it with an error, but not the run."""
    todo = list(run.todo)
    log.info("%d episodes to play, %d played before", len(todo), len(run.episodes) - len(todo))
    for number, which in enumerate(todo, 1):
        session: ChoiceSession | None = None
        try:
            session = run.make(which)
            play(session, player)
            record = run.save(session, **player.notes())
        except UserError:  # the next episode would only meet it again
            raise
        except Exception as error:
            log.warning("%s, episode %d broke", which.task, which.episode, exc_info=True)
            # A player that has not begun still has the notes of the episode before.
            notes = player.notes() if session is not None and session.reveals else {}
            reason = f"{type(error).__name__}: {error}"
            record = run.save_error(which, reason, session, **notes)
        finally:
            if session is not None:
                try:
                    session.close()
                except Exception:  # after a crash there may be nothing left to close
                    log.warning("the simulator could not be closed", exc_info=True)
        log.info("%d/%d %s", number, len(todo), line(record))


def line(record: EpisodeRecord) -> str:
    """One episode in one line."""
    choices = []
    for decision in record.extra["decisions"]:
        choice = decision["choice"]
        if decision["point"] is not None:
            choice += "({:.0f},{:.0f})".format(*decision["point"])
        choices.append(choice)
    parts = [
        f"{record.task} {record.episode}: {record.outcome}",
        " ".join(choices) or "no choice",
        f"{counted(record.steps, 'step')}, {record.seconds.total:.0f} s",
    ]
    reason = record.error or record.extra.get("ended_by", "")
    if reason:
        parts.append(reason)
    return " · ".join(parts)


def print_summary(run: PlayRun) -> None:
    """Print the success rates beside the paper's oracle-planner table."""
    from rich.console import Console
    from rich.table import Table

    rows = run.summary()
    if not rows:
        return
    methods = list(rows[0][3])  # empty for the user's own tasks, which come last
    headings = ["task", "episodes", run.identity.model]
    table = Table(*headings, *[f"{method} (paper)" for method in methods])
    rates = []
    for task, successes, count, paper in rows:
        rate = 100 * successes / count
        rates.append(rate)
        reported = [f"{paper[m]:.0f}" if paper else "–" for m in methods]
        table.add_row(task, str(count), f"{rate:.1f}", *reported)
    if len(rows) > 1:
        n_episodes = sum(count for _, _, count, _ in rows)
        means = []
        for method in methods:
            values = [paper[method] for *_, paper in rows if paper]
            means.append(f"{sum(values) / len(values):.2f}")
        table.add_section()
        mean = sum(rates) / len(rates)
        table.add_row("mean of tasks", str(n_episodes), f"{mean:.2f}", *means)
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(table)
    console.print(
        f"records: {run.folder / 'episodes.jsonl'}", markup=False, highlight=False, soft_wrap=True
    )
