"""A notebook as a page: its text, its code, and the outputs that it keeps."""

import json
import re
from pathlib import Path
from typing import Any

ANSI = re.compile(r"\x1b\[[0-9;]*m")


def page(path: Path) -> str:
    """A notebook's cells as Markdown."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    parts = [f"---\ntitle: {path.name}\n---"] + [
        part for cell in cells for part in cell_parts(cell)
    ]
    return "\n\n".join(parts) + "\n"


def cell_parts(cell: dict[str, Any]) -> list[str]:
    """A cell: Markdown as it is, code as a block with its outputs behind it."""
    source = "".join(cell["source"])
    if cell["cell_type"] != "code":
        return [source]
    outputs = [part for output in cell["outputs"] if (part := output_part(output))]
    return [f"```python\n{source}\n```", *outputs]


def output_part(output: dict[str, Any]) -> str:
    """An output as an image, if it has one, else as text."""
    data = output.get("data", {})
    for kind in ("image/png", "image/jpeg"):
        if kind in data:
            encoded = "".join(data[kind]).replace("\n", "")
            return f'<img alt="output of the cell" src="data:{kind};base64,{encoded}">'
    text = ANSI.sub("", "".join(output.get("text", data.get("text/plain", "")))).rstrip()
    return f"```text\n{text}\n```" if text else ""
