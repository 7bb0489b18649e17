"""A notebook as a page: its text, its code, and the outputs that it keeps."""

import base64
import json
import re
from pathlib import Path
from typing import Any

IMAGE = '<img alt="output of the cell" src="data:image/{};base64,{}">'
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
    """An output in the richest form that it has: HTML, Markdown, an image, else text."""
    data = {kind: "".join(value) for kind, value in output.get("data", {}).items()}
    if "text/html" in data:
        # Within a block of HTML an empty line would begin Markdown anew.
        html = re.sub(r"\n\s*\n", "\n", data["text/html"].strip())
        return f'<div class="output">{html}</div>'
    if "text/markdown" in data:
        return data["text/markdown"].strip()
    if "image/svg+xml" in data:
        return IMAGE.format("svg+xml", base64.b64encode(data["image/svg+xml"].encode()).decode())
    for kind in ("png", "jpeg", "gif", "webp"):
        if f"image/{kind}" in data:
            return IMAGE.format(kind, data[f"image/{kind}"].replace("\n", ""))
    text = ANSI.sub("", "".join(output.get("text", data.get("text/plain", "")))).rstrip()
    return f"```text\n{text}\n```" if text else ""
