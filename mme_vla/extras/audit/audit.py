"""A whole audit: choose the scenes, run the interventions, conclude, write page and JSON."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

from mme_vla.config.sections import Positive, Range
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import require
from mme_vla.evaluation.results.report import Section, html_page
from mme_vla.evaluation.rollout.evaluation import RunOptions, evaluate
from mme_vla.evaluation.rollout.runner import RunFacts
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.audit.conclusion import (
    INTERVENTIONS,
    Conclusion,
    conclude,
    scenes_for,
)
from mme_vla.extras.probing.arms import UNPROBED, slug
from mme_vla.extras.probing.card import Card, measure_card, percent, tables_of
from mme_vla.extras.probing.recordings import Recording
from mme_vla.extras.probing.run import ONLINE, ProbePlan
from mme_vla.policy.base import Policy
from mme_vla.utils import read_json, require_earlier, to_json, write_atomically, write_json

PAGE, FIGURES, PLAN = "audit.html", "audit.json", "plan.json"
MARK = "Audit of"  # stands in the heading of each page
PILOT = 3  # scenes that are run to learn how long one takes
_HOW = (
    (
        "Every arm runs the scenes of the matched run and changes what the policy is sent, never"
        " its weights or its memory. Noise is that of the matched run where the policy takes a"
        " seed. A loss is the matched success minus the arm's, with a 95 % interval (paired"
        " bootstrap over scenes). It is beyond noise if the interval lies above 0 and the loss"
        " exceeds the share of scenes that end otherwise when the matched run is repeated."
    ),
    (
        "Nothing remembered: the episode begins anew at each decision, with the current frame; it"
        " is the floor of a policy that sees the present alone. Own chunks lost: it begins anew and"
        " gets all frames so far."
    ),
)


@dataclass(frozen=True)
class AuditSettings:
    """How much an audit measures; the keys and their meaning are those of `configs/audit.yaml`."""

    resolve: Annotated[float, Range(least=0.02, most=1.0)] = 0.3
    minutes: Positive | None = None


@dataclass(frozen=True)
class Audit:
    """The result of an audit, and its page."""

    card: Card
    conclusion: Conclusion
    page: Path


def run_audit(
    policy: Policy,
    jobs: Sequence[Job],
    folder: Path,
    facts: RunFacts,
    settings: RolloutSettings,
    options: RunOptions,
    audit: AuditSettings = AuditSettings(),
    recordings: Sequence[Recording] = (),
    references: Mapping[str, str] | None = None,
) -> Audit:
    """Run what the folder lacks of an audit, and write its page and its JSON.

    Args:
        jobs: the scenes, task by task. recordings: episodes to take contents, scenes and goals
            from. references: name → folder of records, floors and ceilings.
    """
    for name, mark in ((PAGE, MARK), (FIGURES, "conclusion")):
        require_earlier(folder / name, mark)
    chosen = _within_budget(policy, jobs, folder, facts, settings, options, audit)
    plan = ProbePlan(lend=recordings, jobs=chosen)
    card = measure_card(policy, plan, folder, facts, settings, options, references, INTERVENTIONS)
    conclusion = conclude(card, audit.resolve)
    _write(card, conclusion, folder, policy)
    return Audit(card, conclusion, folder / PAGE)


def scenes_a_task(audit: AuditSettings, n_tasks: int) -> int:
    """How many scenes of each task the stated difference needs."""
    return math.ceil(scenes_for(audit.resolve) / max(n_tasks, 1))


def _within_budget(
    policy: Policy,
    jobs: Sequence[Job],
    folder: Path,
    facts: RunFacts,
    settings: RolloutSettings,
    options: RunOptions,
    audit: AuditSettings,
) -> list[Job]:
    """As many of the scenes as the minutes allow, the same for each task; a repeated command takes
    those of before.
    """
    require(jobs, "There is no scene: name some with tasks=… and episodes=….")
    if audit.minutes is None:
        return list(jobs)
    by_task: dict[str, list[Job]] = {}
    for job in jobs:
        by_task.setdefault(job.task, []).append(job)
    path = folder / PLAN
    if path.is_file():
        most = int(read_json(path, "an audit's plan")["scenes_a_task"])
    else:
        # A few scenes of the matched run tell how long one takes; they count.
        pilot = [job for members in by_task.values() for job in members[:PILOT]]
        output = folder / ONLINE / slug(UNPROBED.name)
        begun = time.monotonic()
        noted = replace(options, notes={"arm": UNPROBED.name})
        evaluate(policy, pilot, output, facts, settings, noted)
        seconds = (time.monotonic() - begun) / len(pilot)
        n_runs = len(INTERVENTIONS) + 2  # the matched run, and its repetition
        affordable = 60 * audit.minutes / (seconds * n_runs)
        most = max(PILOT, int(affordable / len(by_task)))
        most = min(most, max(map(len, by_task.values())))
        write_json(path, {"scenes_a_task": most, "seconds_a_scene": round(seconds, 3)})
    return [job for members in by_task.values() for job in members[:most]]


def _write(card: Card, conclusion: Conclusion, folder: Path, policy: Policy) -> None:
    server = policy.conditions().get("server")
    content = {"conclusion": asdict(conclusion), "card": asdict(card), "server": server}
    write_json(folder / FIGURES, to_json(content))
    short, histories = tables_of(card)
    sections = [
        Section("Conclusion", paragraphs=conclusion.sentences),
        Section(histories.title, tables=[histories]),
        Section(short.title, tables=[short]),
        Section("How the numbers are made", paragraphs=_HOW),
    ]
    title = f"{MARK} {card.model}"
    subtitle = f"checkpoint {card.checkpoint}, {card.scenes} scenes"
    if conclusion.resolution is not None:
        subtitle += f", losses from {percent(conclusion.resolution)} on can be told"
    with write_atomically(folder / PAGE) as draft:
        draft.write_text(html_page(title, sections, subtitle, card.notes), encoding="utf-8")
