"""Pages from the templates in `mme_vla/assets/templates`. HTML is always escaped, Markdown by a
filter.
"""

import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mme_vla.utils import style

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).resolve().parent.parent / "assets" / "templates"


def render(template: str, **values: Any) -> str:
    """Fill in a template; every value that it names must be given."""
    return _environment().get_template(template).render(values)


def escape_markdown(text: str) -> str:
    """Text in one line of Markdown: no name in it becomes a link, an image, HTML, or a cell of its
    own.
    """
    return re.sub(r"[\\|<`]|(?<=\])[(:\[]", r"\\\g<0>", " ".join(text.splitlines()))


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters["markdown"] = escape_markdown
    environment.globals["palette"] = style.css()
    return environment
