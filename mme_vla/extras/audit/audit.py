"""A whole audit: choose the scenes, run the interventions, conclude, write page and JSON."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from mme_vla.config.sections import Positive, Range
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import require
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.audit.conclusion import (
    INTERVENTIONS,
    Conclusion,
    conclude,
    resolution,
)
from mme_vla.extras.audit.floor import RANDOM, RandomPolicy
from mme_vla.extras.probing.arms import UNPROBED, slug
from mme_vla.extras.probing.card import (
    LOSS,
    Card,
    card_page,
    ended_scenes,
    measure_card,
    percent,
)
from mme_vla.extras.probing.interventions import NEEDS
from mme_vla.extras.probing.recordings import Recording
from mme_vla.extras.probing.report import ONLINE, require_earlier
from mme_vla.extras.probing.run import ProbePlan, run_probe
from mme_vla.policy.base import Policy
from mme_vla.utils import read_json, to_json, write_json, write_text

PAGE, FIGURES, PLAN = "audit.html", "audit.json", "plan.json"
MARK = "Audit of"  # in the heading of each page
PILOT = 3  # scenes of each task that are run to learn how long one takes
N_RUNS = len(INTERVENTIONS) + 3  # the matched run, its repetition and the random floor among them
_METHOD = (
    (
        "Every arm runs the scenes of the matched run and changes what the policy is sent, never"
        " its weights or its memory. Noise is that of the matched run where the policy takes a"
        " seed."
    ),
    LOSS,
    (
        "Nothing remembered: the episode begins anew at each decision, with the current frame; it"
        " is the floor of a policy that sees the present alone. Own chunks lost: it begins anew and"
        " gets all frames so far. Random: any option and any point, or chunks from any place of the"
        " recorded episodes."
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
    facts: RunKey,
    settings: RolloutSettings,
    options: RunOptions,
    audit: AuditSettings = AuditSettings(),
    recordings: Sequence[Recording] = (),
    references: Mapping[str, str] | None = None,
) -> Audit:
    """Run what the folder lacks of an audit, and write its page and its JSON.

    Args:
        jobs: the scenes, task by task.
        recordings: episodes to take contents, scenes and goals from.
        references: name → folder of records, floors and ceilings.
    """
    for name, mark in ((PAGE, MARK), (FIGURES, "conclusion")):
        require_earlier(folder / name, mark)
    require(jobs, "There is no scene: name some with tasks=… and episodes=….")
    if audit.minutes is not None:
        jobs = _affordable_scenes(
            jobs,
            folder,
            audit.minutes,
            lambda plan: run_probe(policy, plan, folder, facts, settings, options),
        )
    plan = ProbePlan(lend=recordings, jobs=jobs)
    references = dict(references or {})
    notes = []
    if RANDOM not in references:
        # What the random floor needs and lacks.
        why = None
        if policy.embodiment.readings:
            why = NEEDS["stream"]
        elif not policy.embodiment.action.choice and not recordings:
            why = NEEDS["recordings"]
        if why is None:
            # The scenes with chunks that are taken at random.
            floor = RandomPolicy(policy, plan.lend).eval()
            of_floor = RunKey(RANDOM, "untrained", settings.seed, facts.split, event=facts.event)
            quiet = replace(options, source=None, name=RANDOM, show_forecast=False)
            EvaluationRun(floor, plan.jobs, folder / RANDOM, of_floor, settings, quiet).run()
            references[RANDOM] = str(folder / RANDOM)
        else:
            notes.append(f"{RANDOM} was left out: it needs {why}.")
    card = measure_card(policy, plan, folder, facts, settings, options, references, INTERVENTIONS)
    card = replace(card, notes=[*card.notes, *notes])
    conclusion = conclude(card, audit.resolve, len({job.task for job in plan.jobs}))
    _write(card, conclusion, folder, policy)
    return Audit(card, conclusion, folder / PAGE)


def scenes_a_task(audit: AuditSettings, n_tasks: int) -> int:
    """How many scenes of each task the stated difference needs."""
    n_tasks = max(n_tasks, 1)
    scenes = 1
    while resolution(scenes * n_tasks, n_tasks) > audit.resolve and scenes * n_tasks < 512:
        scenes += 1
    return scenes


def _affordable_scenes(
    jobs: Sequence[Job], folder: Path, minutes: float, run_matched: Callable[[ProbePlan], object]
) -> list[Job]:
    """As many of the scenes as the minutes allow, the same for each task; a repeated command takes
    those of before.
    """
    by_task: dict[str, list[Job]] = {}
    for job in jobs:
        by_task.setdefault(job.task, []).append(job)
    path = folder / PLAN
    if path.is_file():
        n_scenes = int(read_json(path, "an audit's plan")["scenes_a_task"])
    else:
        # A few scenes of the matched run tell how long one takes; they count.
        pilot = ProbePlan(arms=(), jobs=_first_scenes(by_task, PILOT))
        seconds = _seconds_a_scene(pilot, folder / ONLINE / slug(UNPROBED.name), run_matched)
        affordable = int(60 * minutes / (seconds * N_RUNS * len(by_task)))
        n_scenes = min(max(PILOT, affordable), max(map(len, by_task.values())))
        write_json(path, {"scenes_a_task": n_scenes, "seconds_a_scene": round(seconds, 3)})
    return _first_scenes(by_task, n_scenes)


def _first_scenes(by_task: Mapping[str, Sequence[Job]], count: int) -> list[Job]:
    """So many scenes of each task."""
    scenes: list[Job] = []
    for of_task in by_task.values():
        scenes += of_task[:count]
    return scenes


def _seconds_a_scene(
    pilot: ProbePlan, records: Path, run_matched: Callable[[ProbePlan], object]
) -> float:
    """Run the scenes that have no record, and measure how long one takes.

    records: their folder.
    """
    n_recorded = 0
    if records.is_dir():
        n_recorded = len(ended_scenes(records, pilot))
    begun = time.monotonic()
    run_matched(pilot)
    seconds = time.monotonic() - begun
    n_measured = len(pilot.jobs) - n_recorded
    if n_measured:
        return seconds / n_measured
    # An interrupted audit left all records: each has its time, which counts waiting for others.
    totals: list[float] = []
    for of_scene in ended_scenes(records, pilot).values():
        totals += [record.seconds.total for record in of_scene]
    return float(np.mean(totals))


def _write(card: Card, conclusion: Conclusion, folder: Path, policy: Policy) -> None:
    content = {
        "conclusion": asdict(conclusion),
        "card": asdict(card),
        "server": policy.info.server,
    }
    write_json(folder / FIGURES, to_json(content))
    verdict, *reasons = conclusion.sentences
    detail = ""
    if conclusion.resolution is not None:
        detail = f"losses from {percent(conclusion.resolution)} on can be told"
    page = card_page(card, MARK, verdict, _METHOD, reasons, detail)
    write_text(folder / PAGE, page)
