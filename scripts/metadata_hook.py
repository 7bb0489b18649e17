"""Metadata that depends on the address of the project: its links, and the README as a package page
shows it.

Hatchling runs this when it builds the package. The address is `repository` in pyproject.toml, below
`[tool.hatch.metadata.hooks.custom]`, and in no other file.
"""

import re
from pathlib import Path

from hatchling.metadata.plugin.interface import MetadataHookInterface

# `[text](target)` and `![text](target)`. The text of a link may hold an image, but no other link.
LINK = re.compile(r"(!?)\[((?:[^\[\]]|!\[[^\[\]]*\]\([^()\s]*\))*)\]\(([^()\s]+)\)")
CODE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


class CustomMetadataHook(MetadataHookInterface):
    """Fills in `urls` and `readme` of the package."""

    def update(self, metadata: dict) -> None:
        repository = self.config["repository"]
        metadata["urls"] = project_urls(repository)
        readme = Path(self.root, "README.md").read_text(encoding="utf-8")
        metadata["readme"] = {
            "content-type": "text/markdown",
            "text": with_addresses(readme, repository, f"v{metadata['version']}"),
        }


def project_urls(repository: str) -> dict[str, str]:
    """The links beside a package page."""
    return {
        "Homepage": repository,
        "Documentation": f"{repository}/tree/main/docs",
        "Issues": f"{repository}/issues",
        "Changelog": f"{repository}/blob/main/CHANGELOG.md",
    }


def with_addresses(text: str, repository: str, revision: str) -> str:
    """Return Markdown whose relative links and images have the address of their file at a revision.

    A package page shows the text alone, without the files beside it. Blocks of code are unchanged.
    """
    parts = []
    end = 0
    for block in CODE.finditer(text):
        parts += [_replace(text[end : block.start()], repository, revision), block[0]]
        end = block.end()
    parts.append(_replace(text[end:], repository, revision))
    return "".join(parts)


def _replace(text: str, repository: str, revision: str) -> str:
    def link(match: re.Match) -> str:
        mark, label, target = match.groups()
        if "](" in label:
            label = LINK.sub(link, label)
        if re.match(r"[a-z]+:|#", target):
            return f"{mark}[{label}]({target})"
        # A page about a file is HTML. An image needs the bytes of the file.
        kind = "raw" if mark else "blob"
        return f"{mark}[{label}]({repository}/{kind}/{revision}/{target})"

    return LINK.sub(link, text)
