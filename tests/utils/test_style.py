"""One palette for all figures and pages, in light and in dark."""

import re
import subprocess

import pytest

from helpers import REPOSITORY
from mme_vla.utils.style import PALETTE, css, figure, log_scale, svg, themed

HEX = re.compile(r"(?<!\w)#[0-9a-f]{6}\b", re.IGNORECASE)
SUFFIXES = ("*.py", "*.css", "*.html", "*.js", "*.svg")
EXCEPT = {"mme_vla/utils/style.py", "tests/utils/test_style.py"}


def luminance(colour: str) -> float:
    """Relative luminance of WCAG 2."""
    linear = []
    for value in bytes.fromhex(colour[1:]):
        share = value / 255
        linear.append(share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4)
    red, green, blue = linear
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(first: str, second: str) -> float:
    light, dark = sorted([luminance(first), luminance(second)], reverse=True)
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("ground", [0, 1], ids=["light", "dark"])
def test_text_can_be_read_on_its_ground(ground: int) -> None:
    for name in ("ink", "faint", "accent", "good", "bad"):
        for behind in ("card", "page"):
            assert contrast(PALETTE[name][ground], PALETTE[behind][ground]) >= 4.5, (name, behind)


@pytest.mark.parametrize("ground", [0, 1], ids=["light", "dark"])
def test_lines_and_bars_can_be_seen_on_their_ground(ground: int) -> None:
    for name, colours in PALETTE.items():
        if name.startswith("series-"):
            assert contrast(colours[ground], PALETTE["card"][ground]) >= 2.7, name


def test_a_light_colour_has_one_name() -> None:
    light = [colour for colour, _ in PALETTE.values()]
    assert len(set(light)) == len(light)


def test_no_file_has_colours_of_its_own() -> None:
    known = {colour for colours in PALETTE.values() for colour in colours}
    listed = subprocess.run(
        ["git", "ls-files", *SUFFIXES], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    others = {}
    for name in set(listed.stdout.split()) - EXCEPT:
        text = (REPOSITORY / name).read_text(encoding="utf-8")
        if unknown := set(map(str.lower, HEX.findall(text))) - known:
            others[name] = unknown
    assert others == {}


def test_drawings_follow_light_and_dark() -> None:
    with figure((3, 2)) as (canvas, (axes,)):
        axes.plot([0, 1], [0, 1])
        axes.set_xlabel("step")
        drawing = svg(canvas)
    assert f"var(--series-0, {PALETTE['series-0'][0]})" in drawing
    assert f"var(--ink, {PALETTE['ink'][0]})" in drawing
    assert css("svg:root") in drawing  # as a file it has the colours with it
    assert "#ffffff" not in re.sub(r"<style>.*?</style>", "", drawing, flags=re.DOTALL)


def labels_of(drawing: str) -> list[str]:
    return re.findall(r"<text[^>]*>([^<]*)</text>", drawing)


def test_logarithmic_axes_are_labelled_with_numbers() -> None:
    with figure((7, 3), 2, columns=2) as (canvas, (curve, budgets)):
        curve.plot([1, 2, 3], [0.05, 0.5, 2000])
        log_scale(curve.yaxis)
        budgets.plot([16, 64, 1024], [1, 2, 3])
        log_scale(budgets.xaxis, {1024, 16, 64})
        labels = labels_of(svg(canvas))
    assert {"0.05", "0.5", "100", "2,000"} <= set(labels)
    assert [label for label in labels if label in ("16", "64", "1,024", "32", "128")] == [
        "16", "64", "1,024",
    ]  # fmt: skip
    assert not [label for label in labels if "$" in label]


def test_no_other_file_makes_an_axis_logarithmic() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "*.py"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    own = re.compile(r"""set_[xy]scale\(|[xy]scale=|\.(loglog|semilog[xy])\(""")
    found = [
        name
        for name in set(listed.stdout.split()) - EXCEPT
        if own.search((REPOSITORY / name).read_text(encoding="utf-8"))
    ]
    assert found == []


def test_only_colours_of_the_palette_are_named() -> None:
    assert themed("fill: #22303A; stroke: #123456") == "fill: var(--ink, #22303A); stroke: #123456"
