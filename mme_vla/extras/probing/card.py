"""The report card of a checkpoint: measures how far a memory is used as a clock, and how a policy
recovers from a wrong one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.envs.base import environment
from mme_vla.envs.make import make_env
from mme_vla.errors import UserError, require
from mme_vla.evaluation.pairing import pair
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord, RunKey, display_name
from mme_vla.evaluation.results.baselines import is_standing, memory_of
from mme_vla.evaluation.results.report import Section, html_page
from mme_vla.evaluation.results.scopes import Protocol, counted
from mme_vla.evaluation.results.statistics import (
    paired_interval,
    percentiles,
    resampled_means,
    sampled_interval,
)
from mme_vla.evaluation.results.tables import Table, to_markdown
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.extras.probing import lines
from mme_vla.extras.probing.arms import UNPROBED, lacking, meanings_of, read_arm, slug
from mme_vla.extras.probing.channels import channel_of
from mme_vla.extras.probing.evidence import record_evidence
from mme_vla.extras.probing.findings import Findings
from mme_vla.extras.probing.lines import MomentLine
from mme_vla.extras.probing.report import ONLINE, require_earlier
from mme_vla.extras.probing.run import OFFLINE, ProbePlan, run_probe
from mme_vla.extras.probing.writing import required_frames, score_writing
from mme_vla.policy.base import Policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.utils import to_json, write_json, write_text
from mme_vla.utils.pages import escape_markdown

TIME, CONTENT, WRONG_SCENE = "time-shifted", "content-swapped", "wrong scene first"
ARMS = {
    TIME: "delay:64", "order-broken": "shuffle", CONTENT: "swap", WRONG_SCENE: "distract:1",
    "nothing remembered": "drop:all", "oracle frames": "oracle",
}  # fmt: skip
"""What a card measures in closed loop beside the matched run, and the interventions that do it."""
NEGLIGIBLE = 0.01
"""Change of a chunk, in normalised actions, that misleads no policy: one without noise has a spread
of 0.
"""
AGAIN, PAGE, FIGURES = "again", "card.html", "card.json"
MEMORYLESS = "memoryless"  # the reference that was trained without memory
NOT_MEMORYLESS = (
    "“nothing remembered” is this policy with its memory taken away, which is not a memoryless"
    " policy: it was trained to rely on a memory."
)
"""What that arm is not, for pages."""
MARK = "Report card of"  # in the heading of each page
_SAMPLES = 10_000  # of the bootstrap
LOSS = (
    "A loss is the matched success minus the arm's, with a 95 % interval (paired bootstrap over"
    " scenes, exact where all of them agree). It is beyond noise if the interval lies above 0 and"
    " the loss exceeds the share of scenes that end otherwise when the matched run is repeated with"
    " other noise."
)
"""What a loss is, for pages."""
_METHOD = (
    f"Every arm runs the scenes of the matched run with its noise. {LOSS}",
    NOT_MEMORYLESS,
    (
        "The memory-or-clock score is the loss under time shift / (that loss + the loss under"
        " content swap): 1 where a policy reads only time, 0 where it reads only content. It is"
        " undefined where both losses lie within noise."
    ),
    (
        "Recovery counts, on recorded episodes before which another scene is seen, the decisions"
        " until the chunk never again changes by more than the policy's own spread, or"
        f" {NEGLIGIBLE} where the spread is less."
    ),
)


@dataclass(frozen=True)
class Loss:
    """What an arm costs. success: share of the scenes that it solves, 0 to 1. loss: the matched
    share minus it.

    low, high: 95 % interval of the loss.
    lost, gained: scenes that only the matched run solves, or only the arm.
    """

    success: float
    loss: float
    low: float
    high: float
    lost: int
    gained: int
    beyond_noise: bool


@dataclass(frozen=True)
class ClockScore:
    """The memory-or-clock score, 0 to 1, and its 95 % interval; None, with the reason, where it is
    undefined.
    """

    score: float | None = None
    low: float | None = None
    high: float | None = None
    undefined: str | None = None


@dataclass(frozen=True)
class Recovery:
    """Decisions until a policy that saw another scene first acts as without it, on recorded
    episodes.

    A recording has recovered at the first decision from which on the chunk never changes by more
    than the policy's own spread, or `NEGLIGIBLE` where that is more. median: over the recordings;
    None where at least half of them do not recover. recovered: those that do. decisions: mean
    number of decisions of a recording.
    """

    median: float | None
    recovered: int
    recordings: int
    decisions: float


@dataclass(frozen=True)
class Card:
    """Everything a card shows. noise: share of scenes that end otherwise in an equal run with other
    noise.

    interventions: label → the intervention that did it.
    suites: the memory-or-clock score of each suite's scenes, where they are of several.
    writing: score of writing (writing.py).
    references: success of other runs on the same scenes.
    """

    model: str
    checkpoint: int | str
    scenes: int
    matched: float
    noise: float
    arms: dict[str, Loss]
    memory_or_clock: ClockScore
    interventions: Mapping[str, str] = field(default_factory=dict)
    suites: Mapping[str, ClockScore] = field(default_factory=dict)
    recovery: Recovery | None = None
    writing: dict[str, Any] | None = None
    references: dict[str, float] | None = None
    notes: Sequence[str] = ()

    def intervention(self, label: str) -> str:
        """The intervention of an arm, by default that of `ARMS`."""
        return {**ARMS, **self.interventions}.get(label, "")


Outcomes = Mapping[EpisodeKey, float]
"""Success of each scene."""


def run_card(
    policy: Policy,
    plan: ProbePlan,
    folder: Path,
    facts: RunKey,
    settings: RolloutSettings,
    options: RunOptions,
    references: Mapping[str, str] | None = None,
) -> Card:
    """Run what the folder lacks of a card, and write `card.html` and `card.json`.

    Args: as for `measure_card`.
    """
    for name, mark in ((PAGE, MARK), (FIGURES, "memory_or_clock")):
        require_earlier(folder / name, mark)
    card = measure_card(policy, plan, folder, facts, settings, options, references)
    write_card(card, folder)
    return card


def measure_card(
    policy: Policy,
    plan: ProbePlan,
    folder: Path,
    facts: RunKey,
    settings: RolloutSettings,
    options: RunOptions,
    references: Mapping[str, str] | None = None,
    interventions: Mapping[str, str] = ARMS,
) -> Card:
    """Run what the folder lacks of a card.

    Args:
        plan: its jobs are the scenes, its recordings those that recovery is measured on, `lend`
            those to take contents from.
        references: name → folder of records, floors and ceilings such as `{"demonstrator":
            "outputs/…"}`. `memoryless` is a policy that was trained without memory.
        interventions: label → intervention.
    """
    channel = channel_of(policy)
    in_simulation = options.base is make_env and settings.env == "mme_vla"
    arms = {label: read_arm(word) for label, word in interventions.items()}
    possible: dict[str, str] = {}  # those of `interventions` that can be measured
    notes = []
    for label, arm in arms.items():
        why = lacking(
            arm, policy, channel, len(plan.lend), boundaries=in_simulation, n_goals=plan.n_goals
        )
        if why is None:
            possible[label] = interventions[label]
        else:
            notes.append(f"{label} ({interventions[label]}) was left out: it needs {why}.")
    others = {name: _reference(name, place, plan) for name, place in (references or {}).items()}
    if MEMORYLESS not in others:
        notes.append(
            f"{NOT_MEMORYLESS} Train one alike (such as present_modul or pi05), evaluate it on"
            f" these scenes and name its records: references={{{MEMORYLESS}: <folder>}}."
        )

    # In closed loop: every arm, then the matched run again with other noise.
    plan = replace(plan, arms=list(possible.values()), events=())
    run_probe(policy, replace(plan, recordings=()), folder, facts, settings, options)
    again = replace(settings, seed=settings.seed + 1)
    renamed = facts._replace(model=f"{facts.model} · {AGAIN}", model_seed=again.seed)
    EvaluationRun(policy, plan.jobs, folder / AGAIN, renamed, again, options).run()

    # On recorded episodes: how long a wrong scene has an effect.
    recovered = None
    can_recover = policy.info.resamples and WRONG_SCENE in possible
    if plan.recordings and len(plan.lend) > 1 and can_recover:
        offline = replace(plan.offline, moments=None, scan=False)
        wrong = replace(plan, arms=[possible[WRONG_SCENE]], jobs=(), offline=offline)
        run_probe(policy, wrong, folder, facts, settings, options)
        recovered = recovery(Findings.of(lines.read_all(folder / OFFLINE)).moments)
    writing = None
    if options.base is make_env and channel.chooses:
        writing = _writing(policy, plan, settings.env)
    if isinstance(writing, str):
        notes.append(writing)

    # The scenes that are the same in every run.
    online = folder / ONLINE
    unprobed = ended_scenes(online / slug(UNPROBED.name), plan)
    equal = ended_scenes(folder / AGAIN, plan)
    probed = {label: ended_scenes(online / slug(arms[label].name), plan) for label in possible}
    same = pair([unprobed, equal, *probed.values()])
    notes += same.gaps("The arms")
    require(same.keys or not same.left_out, " ".join(same.gaps("The arms")))
    success_of_references = {}
    for name, records in others.items():
        beside = pair([unprobed, records])
        notes += beside.notes(f"references.{name}")
        if beside.keys:
            success_of_references[name] = _mean(_success(records, beside.keys))
    matched = _success(unprobed, same.keys)
    repeated = _success(equal, same.keys)
    outcomes = {label: _success(side, same.keys) for label, side in probed.items()}
    suites = environment(settings.env).suites_of(job.task for job in plan.jobs)
    return replace(
        grade(matched, outcomes, repeated),
        model=facts.model,
        checkpoint=facts.checkpoint,
        interventions=possible,
        suites=clock_scores(matched, outcomes, repeated, suites),
        recovery=recovered,
        references=success_of_references,
        notes=notes,
        writing=writing if isinstance(writing, dict) else None,
    )


def grade(matched: Outcomes, arms: Mapping[str, Outcomes], again: Outcomes) -> Card:
    """A card from outcomes in closed loop.

    Args:
        matched: of the run without an intervention.
        arms: label → outcomes on the same scenes.
        again: of an equal run with other noise.
    """
    in_every_arm = set(again).intersection(*arms.values())
    keys = [key for key in matched if key in in_every_arm]
    require(
        keys,
        "No scene ended in every arm: each ended in an error somewhere. Repeat the command to try"
        " them again.",
    )
    noise = _mean({key: abs(matched[key] - again[key]) for key in keys})
    table = {}
    for label, outcomes in arms.items():
        table[label] = {key: matched[key] - outcomes[key] for key in keys}
    # Means over tasks of scenes resampled within each task, the same ones for all arms
    sampled = {}
    if table:
        tables = [_by_task(differences) for differences in table.values()]
        tasks = {}
        for task in tables[0]:
            tasks[task] = [of_arm[task] for of_arm in tables]
        sampled = dict(zip(table, resampled_means(tasks, _SAMPLES, seed=0), strict=True))
    losses = {}
    for label, differences in table.items():
        loss = _mean(differences)
        interval = sampled_interval(sampled[label], paired_interval(_by_task(differences)))
        signs = np.sign(list(differences.values()))
        losses[label] = Loss(
            success=_mean({key: arms[label][key] for key in keys}),
            loss=loss,
            low=interval.low,
            high=interval.high,
            lost=int((signs > 0).sum()),
            gained=int((signs < 0).sum()),
            beyond_noise=interval.low > 0 and loss > noise,
        )
    score = clock_score(losses, sampled)
    return Card("", "", len(keys), _mean({key: matched[key] for key in keys}), noise, losses, score)


def clock_score(losses: Mapping[str, Loss], sampled: Mapping[str, np.ndarray]) -> ClockScore:
    """The memory-or-clock score. sampled: the losses of each arm on the same resampled scenes,
    [samples].
    """
    if missing := [label for label in (TIME, CONTENT) if label not in losses]:
        return ClockScore(undefined=f"{' and '.join(missing)} could not be measured")
    if not any(losses[label].beyond_noise for label in (TIME, CONTENT)):
        return ClockScore(undefined="neither loss is beyond noise")

    def share(time: Any, content: Any) -> Any:
        time, content = np.maximum(time, 0.0), np.maximum(content, 0.0)
        known = time + content > 0
        return time[known] / (time + content)[known]

    interval = percentiles(share(sampled[TIME], sampled[CONTENT]))
    score = share(np.array([losses[TIME].loss]), np.array([losses[CONTENT].loss]))
    return ClockScore(float(score[0]), interval.low, interval.high)


def clock_scores(
    matched: Outcomes, arms: Mapping[str, Outcomes], again: Outcomes, task_suites: Mapping[str, str]
) -> dict[str, ClockScore]:
    """The memory-or-clock score of each suite's scenes; none where all are of one.

    task_suites: task → suite, of environments that are not RoboMME. The rest is as `grade` has it.
    """

    def select(outcomes: Outcomes, tasks: Sequence[str]) -> Outcomes:
        return {key: value for key, value in outcomes.items() if key.task in tasks}

    in_every_arm = set(again).intersection(*arms.values())
    names = dict.fromkeys(key.task for key in matched if key in in_every_arm)
    protocol = Protocol(tuple(names), task_suites=task_suites)
    suites = {suite: protocol.choose("suite", suite) for suite in protocol.suites}
    if len(suites) < 2:
        return {}
    scores = {}
    for suite, tasks in suites.items():
        arms_of_suite = {label: select(arm, tasks) for label, arm in arms.items()}
        card = grade(select(matched, tasks), arms_of_suite, select(again, tasks))
        scores[suite] = card.memory_or_clock
    return scores


def recovery(moments: Sequence[MomentLine]) -> Recovery | None:
    """How long the wrong scene has an effect. moments: of one arm, at every decision of each
    recording.
    """
    misled: dict[str, list[bool]] = {}
    for line in sorted(moments, key=lambda line: line.step):
        misled.setdefault(line.recording, []).append(line.change > max(line.spread, NEGLIGIBLE))
    if not misled:
        return None
    after = []  # decisions until a recording has recovered
    for flags in misled.values():
        recovered_at = 1 + max(np.flatnonzero(flags), default=-1)
        after.append(recovered_at if recovered_at < len(flags) else np.inf)
    median = float(np.median(after))
    return Recovery(
        median=median if np.isfinite(median) else None,
        recovered=int(np.isfinite(after).sum()),
        recordings=len(after),
        decisions=float(np.mean([len(flags) for flags in misled.values()])),
    )


def outcomes_of(records: Iterable[EpisodeRecord]) -> dict[EpisodeKey, float]:
    """Success of each scene, averaged where it was run several times; scenes that ended in an error
    are left out.
    """
    runs: dict[EpisodeKey, list[float]] = {}
    for record in records:
        if record.outcome != "error":
            runs.setdefault(record.key, []).append(float(record.success))
    return {key: float(np.mean(values)) for key, values in runs.items()}


Scenes = dict[EpisodeKey, list[EpisodeRecord]]
"""The records of each scene that ended by itself."""


def _success(records: Scenes, keys: Iterable[EpisodeKey]) -> dict[EpisodeKey, float]:
    """Success of these scenes."""
    return outcomes_of(chain.from_iterable(records[key] for key in keys))


def ended_scenes(folder: Path, plan: ProbePlan) -> Scenes:
    """Records of the plan's scenes in a folder; those that ended in an error are left out."""
    scenes = {(job.task, job.split, job.episode) for job in plan.jobs}
    records = read_folders(path for path in find_records([folder]) if path.parent == folder)
    by_scene: Scenes = {}
    for record in records:
        if record.outcome != "error" and (record.task, record.split, record.episode) in scenes:
            by_scene.setdefault(record.key, []).append(record)
    return by_scene


def _reference(name: str, place: str, plan: ProbePlan) -> Scenes:
    """Records of another run on the scenes of the card."""
    records = ended_scenes(Path(place).expanduser(), plan)
    require(
        records,
        f"references.{name}={place} holds no record of the card's scenes: evaluate it on the same"
        " ones.",
    )
    for record in chain.from_iterable(records.values()):
        require(
            name != MEMORYLESS or not memory_of(record.model) or is_standing(record.model),
            f"references.{name} holds records of {record.model}, which has a memory: name those of"
            " present_*, actions_* or pi05, or give the reference another name.",
        )
    return records


def _mean(values: Outcomes) -> float:
    """Mean over tasks of the means over their scenes."""
    return float(np.mean([of_task.mean() for of_task in _by_task(values).values()]))


def _by_task(values: Outcomes) -> dict[str, np.ndarray]:
    """The values of each task's scenes, in order."""
    tasks: dict[str, list[float]] = {}
    for key, value in values.items():
        tasks.setdefault(key.task, []).append(value)
    return {task: np.array(of_task) for task, of_task in tasks.items()}


def _writing(policy: Policy, plan: ProbePlan, name: str) -> dict[str, Any] | str:
    """The score of writing on demonstrations of the card's scenes, or why there is none.

    name: of their environment.
    """
    memory, env = policy.require_memory(), environment(name)
    try:
        frames = required_frames(memory)
        episodes = []
        for job in plan.jobs:
            spec = env.episode(job.task, job.split, job.episode)
            episode = record_evidence(spec, frames, name)
            if episode is not None:
                episodes.append(episode)
        encoder = policy if isinstance(policy, MMEPolicy) else None
        scores: dict[str, Any] = score_writing(memory, episodes, encoder).to_dict()
    except UserError as error:
        return f"No score of writing: {error}"
    if not scores["tasks"]:
        return "No score of writing: no scene has a fact that a frame shows."
    return scores


def tables_of(card: Card) -> list[Table]:
    """The card as tables."""
    after = card.recovery
    rows = [["memory-or-clock score", _score(card.memory_or_clock)]]
    for suite, score in card.suites.items():
        rows.append([f"memory-or-clock score, {suite}", _score(score)])
    rows.append(["noise: scenes that end otherwise in an equal run", percent(card.noise)])
    if after is not None:
        median = "no" if after.median is None else f"{after.median:g} decisions"
        text = (
            f"{median} (median); {after.recovered} of {after.recordings} within"
            f" {after.decisions:.1f} decisions on average"
        )
        rows.append(["recovery after another scene", text])
    if card.writing is not None:
        mean = card.writing["mean"]
        rows.append(["score of writing", f"{mean['score']:.2f} (chance {mean['chance']:.2f})"])
    arms = [["matched", "", percent(card.matched), "", "", "", ""]]
    for label, loss in card.arms.items():
        arms.append([
            label, card.intervention(label), percent(loss.success), percent(loss.loss),
            f"[{100 * loss.low:.0f}, {100 * loss.high:.0f}]", f"{loss.lost} : {loss.gained}",
            "yes" if loss.beyond_noise else "no",
        ])  # fmt: skip
    for name, rate in (card.references or {}).items():
        arms.append([name, "", percent(rate), "", "", "", ""])
    columns = "history", "intervention", "success", "loss", "95 %", "lost : gained", "beyond noise"
    return [
        Table("In short", ("figure", "value"), rows),
        Table("Histories in closed loop", columns, arms),
    ]


def conclude_card(card: Card) -> str:
    """What the card shows, in a sentence, or that it is too little to tell."""
    scenes = counted(card.scenes, "scene")
    score = card.memory_or_clock
    losses = []
    for label in (TIME, CONTENT):
        if label in card.arms:
            losses.append(f"{label} entries cost {100 * card.arms[label].loss:.0f} points")
    text = f"This policy solves {percent(card.matched)} of {scenes}"
    if card.references and MEMORYLESS in card.references:
        text += f" (a memoryless training {percent(card.references[MEMORYLESS])})"
    if losses:
        text += f", {' and '.join(losses)}"
    if score.score is None or score.low is None or score.high is None:
        return f"{text}: too little to tell whether its memory is a clock ({score.undefined})."
    if score.low > 0.5:
        kind = "its memory serves mostly as a clock"
    elif score.high < 0.5:
        kind = "its memory serves mostly by its content"
    else:
        kind = "it reads times and contents, or the scenes are too few to tell which more"
    return f"{text}: {kind} (memory-or-clock score {_score(score)})."


def write_card(card: Card, folder: Path) -> None:
    """Write the page and the JSON."""
    write_json(folder / FIGURES, to_json(asdict(card)))
    page = card_page(card, MARK, conclude_card(card), _METHOD)
    write_text(folder / PAGE, page)


def card_page(
    card: Card,
    mark: str,
    lead: str,
    method: Sequence[str],
    reasons: Sequence[str] = (),
    detail: str = "",
) -> str:
    """The card as an HTML page.

    Args:
        mark: what its heading begins with.
        lead: the conclusion.
        method: how the numbers are made.
        reasons: what the conclusion follows from.
        detail: end of the subtitle.
    """
    meanings = meanings_of(map(card.intervention, card.arms))
    terms = [("matched", UNPROBED.meaning)]
    terms += [(label, meanings.get(card.intervention(label), "")) for label in card.arms]
    short, histories = tables_of(card)
    sections = []
    if reasons:
        sections.append(Section("What the conclusion follows from", paragraphs=reasons))
    sections += [
        Section(short.title, tables=[short]),
        Section(histories.title, tables=[histories], terms=terms),
        Section("How the numbers are made", paragraphs=method),
    ]
    sizes = [f"checkpoint {card.checkpoint}", f"{counted(card.scenes, 'scene')} in closed loop"]
    if detail:
        sizes.append(detail)
    return html_page(
        f"{mark} {display_name(card.model, card.checkpoint)}",
        sections,
        " · ".join(sizes),
        lead=lead,
        footnotes=card.notes,
    )


def card_text(card: Card, lead: str = "") -> str:
    """The card in Markdown. lead: the conclusion, by default that of `conclude_card`."""
    bold = f"**{escape_markdown(lead or conclude_card(card))}**\n"
    return "\n".join([bold, *map(to_markdown, tables_of(card)), *card.notes])


def _score(score: ClockScore) -> str:
    if score.undefined is not None:
        return f"undefined: {score.undefined}"
    return f"{score.score:.2f} [{score.low:.2f}, {score.high:.2f}]"


def percent(share: float) -> str:
    return f"{100 * share:.0f} %"
