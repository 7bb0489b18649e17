"""The look of all figures and pages: colours in light and dark, sizes and fonts, in one place.

A figure is drawn in the light colours. `svg` then names them (`var(--ink, …)`), so that a page's
style sheet, or a viewer that prefers dark, shows the same drawing on a dark ground.
"""

import io
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure as Canvas

PALETTE = {
    "ink": ("#22303a", "#dde6eb"),
    "faint": ("#5f6f7b", "#9fb0bb"),
    "line": ("#dfe5e9", "#35454f"),
    "card": ("#ffffff", "#222d35"),
    "page": ("#f7f9fa", "#182026"),
    "accent": ("#17627c", "#6fc0da"),
    "bar": ("#1f6f8c", "#17465a"),
    "warm": ("#c25e16", "#f0975a"),
    "warm-ground": ("#fff5ec", "#3a2b20"),
    "series-0": ("#1f6f8b", "#5fb3d0"),
    "series-1": ("#e07a2f", "#f0975b"),
    "series-2": ("#5a9367", "#86c093"),
    "series-3": ("#8d5a97", "#c193cc"),
    "series-4": ("#c44536", "#ea8374"),
    "series-5": ("#7a8b99", "#9fb0be"),
    "series-6": ("#b8972f", "#d9bb5c"),
    "series-7": ("#3d5a80", "#8cabd6"),
    "raster": ("#3f8fae", "#3f8faf"),
    "video": ("#7aa2cd", "#7aa2ce"),
    "border": ("#e5484d", "#e5484e"),
    "good": ("#18794e", "#3dd68c"),
    "bad": ("#c62a2f", "#ff7a7f"),
}
"""Name → colour on light and on dark ground. `series-N` are those of lines and bars, `video` and
`series-1` of the frames before and after execution begins, `border` of a conditioning video, and
`raster` of bitmaps, which cannot follow the ground.
Light colours differ from each other, since `svg` finds the name by the colour.
"""


def colour(name: str) -> str:
    """Return a colour of the palette on light ground."""
    return PALETTE[name][0]


def rgb(name: str, dark: bool = False) -> tuple[int, int, int]:
    """Return a colour of the palette, on light or on dark ground, for Pillow, 0 to 255."""
    red, green, blue = bytes.fromhex(PALETTE[name][dark][1:])
    return red, green, blue


COLOURS = tuple(colour(name) for name in PALETTE if name.startswith("series-"))
INK, FAINT, LINE, CARD = colour("ink"), colour("faint"), colour("line"), colour("card")
VIDEO, EXECUTION = colour("video"), COLOURS[1]
ON_LIGHT, ON_DARK = "#101010", "#fefefe"
"""Ink on a cell that has a colour of its own, the same on both grounds."""
DPI = 130  # of bitmaps
_RC = {
    "svg.fonttype": "none",
    "svg.hashsalt": "mme_vla",
    "font.family": "sans-serif",
    "font.size": 10,
    "axes.titlesize": 11,
    "legend.fontsize": 9,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "text.color": INK,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": LINE,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
    "text.parse_math": False,  # a name may hold dollar signs
}


@contextmanager
def look() -> Iterator[None]:
    """Give figures that are drawn and saved inside this block the project's look."""
    import matplotlib
    from cycler import cycler

    with matplotlib.rc_context({**_RC, "axes.prop_cycle": cycler(color=COLOURS)}):  # type: ignore[dict-item]
        yield


@contextmanager
def figure(
    size: tuple[float, float], panels: int = 1, columns: int = 1
) -> "Iterator[tuple[Canvas, list[Axes]]]":
    """Open a figure of panels in rows under each other, in the project's look.

    Args:
        size: width and height in inches.
        panels: how many.
        columns: panels beside each other.
    """
    from matplotlib.figure import Figure as Canvas

    with look():
        canvas = Canvas(size, layout="constrained")
        rows = -(-panels // columns)
        grid = canvas.subplots(rows, columns, squeeze=False, sharex=columns == 1)
        yield canvas, list(grid.flat[:panels])


def svg(canvas: "Canvas") -> str:
    """Return the figure as an SVG element, for a page or as a file, that follows light and dark."""
    out = io.StringIO()
    canvas.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue()
    text = themed(text[text.index("<svg") :])
    return re.sub(r"(<svg[^>]*>)", rf"\1\n<style>{css('svg:root')}</style>", text, count=1)


def themed(text: str) -> str:
    """Return SVG or CSS whose light colours of the palette are named, and so follow the ground."""
    names = {light: name for name, (light, _) in PALETTE.items()}
    pattern = re.compile("|".join(names), re.IGNORECASE)
    return pattern.sub(lambda hit: f"var(--{names[hit[0].lower()]}, {hit[0]})", text)


def css(selector: str = ":root") -> str:
    """Return the rule that gives an element the palette, light or dark as its viewer prefers."""
    values = [f"--{name}: light-dark({light}, {dark});" for name, (light, dark) in PALETTE.items()]
    return "\n".join([f"{selector} {{", "color-scheme: light dark;", *values, "}\n"])


def log_scale(axis: "Axis", ticks: Collection[float] = ()) -> None:
    """Make an axis logarithmic, labelled with numbers.

    The labels that matplotlib gives a logarithmic axis are math text, which the look turns off.

    Args:
        ticks: what is labelled, in data units; empty for 1, 2 and 5 of each decade.
    """
    from matplotlib.ticker import FixedLocator, LogLocator, NullLocator

    axes = axis.axes
    if axis is axes.xaxis:
        axes.set_xscale("log")
    else:
        axes.set_yscale("log")
    axis.set_major_locator(FixedLocator(sorted(ticks)) if ticks else LogLocator(subs=(1, 2, 5)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter("{x:,.6g}")


def legend(canvas: "Canvas", axes: "Axes", columns: int) -> None:
    """Add a legend above the panel, clear of its content, in so many columns at most."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        # last, in the bars
        order = sorted(range(len(labels)), key=lambda i: labels[i].endswith("paper"))
        canvas.legend(
            [handles[i] for i in order],
            [labels[i] for i in order],
            loc="outside upper center",
            ncols=min(len(labels), columns),
        )
