"""The figures of a probe's page, as SVG text."""

from mme_vla.evaluation.probe.findings import Findings
from mme_vla.evaluation.results.plots import COLOURS, FAINT, INK, legend, picture, svg

_ON = {"distract": "episodes before one's own", "delay": "frames that the clock runs ahead",
       "pause": "still frames", "recent": "frames that may be remembered", "drop": "entries taken away"}  # fmt: skip


def effects(findings: Findings) -> str:
    """A bar an arm: the mean change of the chunk; the line is the policy's own spread."""
    arms = findings.arms()
    with picture((10.4, 3.4)) as (canvas, (axes,)):
        axes.bar(range(len(arms)), [found.change for found in arms.values()], 0.7, color=COLOURS[0])
        ends = [(i - 0.42, i + 0.42) for i in range(len(arms))]
        axes.hlines([found.spread for found in arms.values()], *zip(*ends, strict=True), color=COLOURS[1], lw=2,
                    label="the policy's own spread")  # fmt: skip
        axes.set_xticks(range(len(arms)), list(arms), rotation=25, ha="right", rotation_mode="anchor")
        axes.set_ylabel("change of the chunk")
        legend(canvas, axes, 3)
        return svg(canvas)


def decay(findings: Findings) -> str:
    """What an entry matters by its age, those of the video and of the execution."""
    with picture((5.6, 3.4)) as (canvas, (axes,)):
        for name, video, colour in (("video", True, COLOURS[0]), ("execution", False, COLOURS[1])):
            points = findings.decay(video)
            mine = [e for e in findings.entries if e.video == video]
            if mine:
                axes.scatter([e.age for e in mine], [e.change for e in mine], s=8, color=colour, alpha=0.25, lw=0)
                means = [found.change for _, found in points]
                axes.plot([age for age, _ in points], means, "-o", color=colour, ms=5, label=name)
        spread = [entry.spread for entry in findings.entries]
        if spread:
            axes.axhline(sum(spread) / len(spread), color=FAINT, lw=1, ls="--", label="own spread")
        axes.set_xlabel("age of the entry (frames)")
        axes.set_ylabel("change without it")
        legend(canvas, axes, 3)
        return svg(canvas)


def dials(findings: Findings) -> dict[str, str]:
    """A curve for each intervention of which several places of the dial were probed."""
    drawn = {}
    for name, points in findings.families().items():
        with picture((5.6, 3.0)) as (canvas, (axes,)):
            axes.plot([0, *(x for x, _ in points)], [0, *(f.change for _, f in points)], "-o", color=COLOURS[0], ms=5)
            axes.axhline(points[0][1].spread, color=COLOURS[1], lw=1, ls="--")
            axes.set_xlabel(_ON.get(name, name))
            axes.set_ylabel("change of the chunk")
            axes.tick_params(colors=INK)
            drawn[name] = svg(canvas)
    return drawn
