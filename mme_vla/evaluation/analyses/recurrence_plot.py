"""The curves of a recurrent memory as a picture."""

from collections.abc import Sequence

from mme_vla.evaluation.analyses.recurrence import RecurrenceCurves
from mme_vla.evaluation.results.plots import COLOURS, FAINT, picture, svg

_PAIR = ("inner_loss_before", "inner_loss_after")


def recurrence_plot(episodes: Sequence[RecurrenceCurves], title: str) -> str:
    """One panel a number, one colour an episode, over the frames taken; a dotted line where its video ends.

    TTT's loss before and after a frame's update share a panel: dashed before, solid after.
    """
    names = list(episodes[0].curves)
    panels = ["inner loss" if name == _PAIR[0] else name for name in names if name != _PAIR[1]]
    with picture((7.5, 2.3 * len(panels) + 0.6), len(panels)) as (canvas, axes):
        for panel, name in zip(axes, panels, strict=True):
            for i, episode in enumerate(episodes):
                colour = COLOURS[i % len(COLOURS)]
                drawn = [(_PAIR[0], "--"), (_PAIR[1], "-")] if name == "inner loss" else [(name, "-")]
                for curve, style in drawn:
                    label = f"episode {episode.episode}" if style == "-" else None
                    panel.plot(episode.frames, episode.curves[curve], style, color=colour, lw=1.4, label=label)
                if episode.exec_start:
                    panel.axvline(episode.exec_start, color=colour, ls=":", lw=0.9)
            panel.set_title(name.replace("_", " "), loc="left", fontsize=10)
            panel.set_ylim(bottom=0)
        axes[-1].set_xlabel("frame of the episode")
        canvas.suptitle(title, x=0.02, ha="left", color=FAINT, fontsize=10)
        canvas.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9)
        return svg(canvas)
