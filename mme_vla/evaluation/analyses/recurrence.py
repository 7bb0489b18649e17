"""What a recurrent memory reports frame by frame: TTT's inner loss, step sizes and clipping, RMT's change of slots."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from mme_vla.data.episodes import EpisodeSource
from mme_vla.errors import UserError
from mme_vla.evaluation.analyses.replay import STRIDE, replay
from mme_vla.evaluation.results.plots import COLOURS, FAINT, figure, svg
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.policy.mme import MMEPolicy


@dataclass(frozen=True)
class RecurrenceCurves:
    """One episode's recurrence: frames [t] it took, in order, and a number of each by name.

    TTT: `inner_loss_before` and `inner_loss_after` the update by this frame, `step_size`, `clipped_gradients`,
    `clipped_rates` (shares). RMT: `slot_change`, relative.
    """

    episode: int
    exec_start: int
    frames: np.ndarray
    curves: dict[str, np.ndarray]


@torch.no_grad()
def recurrence_curves(policy: MMEPolicy, source: EpisodeSource, episode: int, stride: int = STRIDE) -> RecurrenceCurves:
    """Run the memory over the window it has at an episode's last chunk."""
    memory = policy.memory
    if not isinstance(memory, RecurrentMemory):
        raise UserError("This policy has no recurrent memory: choose one such as ttt_modul or rmt_expert.")
    last = None
    for last in replay(policy, source, episode, stride):  # noqa: B007  (only the last is wanted)
        pass
    assert last is not None
    step, running = last
    history = running.required_history()
    window = running.gather_selection()
    with policy.autocast():
        features, positions, mask = (
            x[None].to(policy.device) for x in (window.features, window.positions, window.mask)
        )
        x = memory.encoder(features, positions, mask)
        patches = memory.storage.grid**2
        frames = x.unflatten(1, (-1, patches))
        valid = mask.unflatten(1, (-1, patches)).all(-1)
        _, numbers = memory.layer.advance(memory.init_state(1), frames, valid, statistics=True)
    real = valid[0].cpu().numpy()
    curves = {name: values[0].float().cpu().numpy()[real] for name, values in numbers.items()}
    return RecurrenceCurves(episode, history.exec_start, memory.frames(history, step), curves)


_PAIR = ("inner_loss_before", "inner_loss_after")


def recurrence_plot(episodes: Sequence[RecurrenceCurves], title: str) -> str:
    """One panel a number, one colour an episode, over the frames taken; a dotted line where its video ends.

    TTT's loss before and after a frame's update share a panel: dashed before, solid after.
    """
    names = list(episodes[0].curves)
    panels = ["inner loss" if name == _PAIR[0] else name for name in names if name != _PAIR[1]]
    with figure((7.5, 2.3 * len(panels) + 0.6), len(panels)) as (canvas, axes):
        for panel, name in zip(axes, panels, strict=True):
            for i, episode in enumerate(episodes):
                colour = COLOURS[i % len(COLOURS)]
                curve_styles = [(_PAIR[0], "--"), (_PAIR[1], "-")] if name == "inner loss" else [(name, "-")]
                for curve, style in curve_styles:
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
