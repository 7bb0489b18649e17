"""What a probe found, in a sentence or two: the first thing that its page says."""

from collections.abc import Sequence

from mme_vla.evaluation.results.compare import Comparison
from mme_vla.evaluation.results.scopes import counted
from mme_vla.evaluation.results.statistics import sign_test
from mme_vla.extras.probing.findings import UNCHANGED, Effect, Findings, by_recording

EVERYTHING = "drop:all"
CONFIDENCE = 0.95


def conclude(findings: Findings, comparisons: Sequence[Comparison]) -> str:
    """What recorded episodes and closed loop say; empty without either.

    comparisons: of each arm, as `first`, with the unprobed run.
    """
    sentences = []
    if findings.moments:
        sentences.append(_on_recordings(findings))
    if comparisons:
        sentences.append(_in_closed_loop(comparisons))
    return " ".join(sentences)


def _on_recordings(findings: Findings) -> str:
    arms = findings.arms()
    if not findings.changed:
        tried = f"None of the {len(arms)} interventions changes"
        if len(arms) == 1:
            tried = f"{next(iter(arms))} does not change"
        if not any(line.entries for line in findings.moments):
            reads = "this policy acts on what it sees now alone"
        elif EVERYTHING in arms:
            reads = "this policy does not read its memory"
        else:
            reads = f"with=[{EVERYTHING}] tells whether this policy reads its memory at all"
        return f"{tried} the actions: {reads} ({findings.size})."

    if all(effect_of.change < UNCHANGED for effect_of in arms.values()):
        return (
            "The interventions leave the actions as they are, and leaving out a single entry"
            f" changes them: this policy reads its memory ({findings.size})."
        )

    # Of all interventions the one that removes everything says most, then the strongest.
    name = max(arms, key=lambda arm: arms[arm].change)
    if EVERYTHING in arms and arms[EVERYTHING].change >= UNCHANGED:
        name = EVERYTHING
    lines = [line for line in findings.moments if line.arm == name]
    cause = f"Of {counted(len(arms), 'intervention')}, {name}"
    if name == EVERYTHING:
        cause = "Removing the memory"
    reads = "this policy depends on what it saw before"
    if any(line.touched for line in lines):
        reads = "this policy reads its memory"
    if name.startswith("subgoal_"):
        reads = "this policy reads its subgoal"
    mean = arms[name]
    if mean.times is None:
        return (
            f"{cause} changes the actions by {mean.change:.2f} (1 is half of what the training data"
            f" span), and noise changes nothing: {reads} ({findings.size})."
        )
    sentence = f"{cause} changes the actions {show_times(mean.times)} times as much as noise does"
    return f"{sentence}{_against_noise(by_recording(lines), mean, reads)} ({findings.size})."


def _against_noise(episodes: Sequence[Effect], mean: Effect, reads: str) -> str:
    """The end of a sentence: whether the effect exceeds noise, or episodes are too few to tell.

    episodes: the effect in each recorded episode.
    """
    above = sum(episode.change > episode.spread for episode in episodes)
    below = len(episodes) - above
    exceeds = mean.change > mean.spread
    if len(episodes) == 1:
        end = reads if exceeds else "the change is no larger than noise"
        return f": {end}. One recorded episode is too few to tell for others"
    if not below:
        return f": {reads}"
    if not above:
        return ": what is changed matters less than noise"
    if sign_test(above, below) < 1 - CONFIDENCE:
        if above > below:
            return f", and more than noise in {above} of {len(episodes)} episodes: {reads}"
        return f", and less than noise in {below} of {len(episodes)} episodes: it matters little"
    if sign_test(len(episodes), 0) >= 1 - CONFIDENCE:
        end = f"{len(episodes)} episodes are too few to tell whether it matters more than noise"
    else:
        end = "it does not clearly matter more than noise"
    return f", and more than noise in {above} of {len(episodes)} episodes: {end}"


def _in_closed_loop(comparisons: Sequence[Comparison]) -> str:
    """One arm gets its verdict, of several those that cost success, or why none is known to."""
    named = [comparison for comparison in comparisons if comparison.first == EVERYTHING]
    if len(comparisons) == 1 or (named and not named[0].significant):
        verdict = f"In closed loop: {[*named, *comparisons][0].verdict}."
        if len(comparisons) == 1:
            return verdict
    else:
        verdict = ""
    n_arms = f"the {len(comparisons)} interventions in closed loop"
    worse = [c.first for c in comparisons if c.significant and c.losses > c.wins]
    better = [c.first for c in comparisons if c.significant and c.wins > c.losses]
    if worse or better:
        found = []
        if worse:
            verb = "costs" if len(worse) == 1 else "cost"
            found.append(f"{', '.join(worse)} {verb} success significantly")
        if better:
            verb = "raises" if len(better) == 1 else "raise"
            found.append(f"{', '.join(better)} {verb} success significantly")
        sentence = f"Of {n_arms}, {' and '.join(found)}."
    elif not any(c.wins or c.losses for c in comparisons):
        episodes = counted(max(c.episodes for c in comparisons), "scene")
        return f"None of {n_arms} changes the outcome of any of {episodes}."
    elif not any(c.testable for c in comparisons):
        sentence = f"For all of {n_arms} there are too few episodes to tell."
    else:
        sentence = f"None of {n_arms} changes success significantly."
    return f"{verdict} {sentence}".strip()


def show_times(times: float) -> str:
    """How many times the own spread an effect is, as one prints it."""
    return f"{times:.0f}" if times >= 10 else f"{times:.1f}"
