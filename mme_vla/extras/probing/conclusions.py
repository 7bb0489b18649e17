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
    times = f"{mean.times:.0f}" if mean.times >= 10 else f"{mean.times:.1f}"
    sentence = f"{cause} changes the actions {times} times as much as noise does"
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
    if len(comparisons) == 1:
        return f"In closed loop: {comparisons[0].verdict}."
    verdict = ""
    worse = []
    better = []
    for comparison in comparisons:
        if not verdict and comparison.first == EVERYTHING and not comparison.significant:
            verdict = f"In closed loop: {comparison.verdict}."
        if comparison.significant and comparison.losses > comparison.wins:
            worse.append(comparison.first)
        elif comparison.significant and comparison.wins > comparison.losses:
            better.append(comparison.first)
    n_arms = f"the {len(comparisons)} interventions in closed loop"
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
