"""The baselines that belong beside memories in every table: what a policy solves without having
seen the past.
"""

from collections.abc import Iterable

STANDING = {"present": "the current frame alone", "actions": "the robot's own past actions"}
"""Memory of a standing baseline → what it holds."""
_INTEGRATIONS = ("modul", "context", "expert", "film")  # ends of the models' names


def memory_of(model: str) -> str:
    """The memory in a model's name, as in `<memory>_<integration>`; empty for other names."""
    memory, _, integration = model.partition("@")[0].rpartition("_")
    return memory if integration in _INTEGRATIONS else ""


def is_standing(model: str) -> bool:
    """Whether a model is a standing baseline."""
    return memory_of(model) in STANDING


def missing_baselines(models: Iterable[str]) -> list[str]:
    """A sentence for each standing baseline that a comparison of these models lacks; none where
    fewer than two models are compared, or none of them has a memory.
    """
    names = list(dict.fromkeys(models))
    remembering = [name for name in names if memory_of(name) and not is_standing(name)]
    if len(names) < 2 or not remembering:
        return []
    integration = remembering[0].partition("@")[0].rpartition("_")[2]
    present = {memory_of(name) for name in names}
    sentences = []
    for memory, content in STANDING.items():
        if memory not in present:
            sentences.append(
                f"This table lacks {memory}_*, a memory of {content}: train"
                f" {memory}_{integration} to compare."
            )
    return sentences
