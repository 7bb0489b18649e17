"""What a `Processor` is built from: settings in words, and the files that a checkpoint names in itself."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, brief, did_you_mean, listed
from mme_vla.files import check_sums, inside
from mme_vla.processing.base import CONFIG_FILE, read_settings
from mme_vla.processing.normalisers import NormStats
from mme_vla.processing.prompt import PROMPTS
from mme_vla.processing.tokenizer import HUB, PALIGEMMA, SAMPLE, Tokenizer

TOKENIZER_FILE = "tokenizer.model"
OLD_VIEWS = ["base_0_rgb", "left_wrist_0_rgb"]  # what processors named before robots could be chosen: front and wrist


def constructor_settings(config: Mapping[str, Any], arguments: Iterable[str]) -> dict[str, Any]:
    """The arguments of a processor's constructor out of the words of `Processor.from_config`.

    Args:
        arguments: the constructor's, by name.

    Raises:
        UserError: an unknown, missing or impossible entry.
    """
    settings = dict(config)
    known = {*arguments, "tokenizer_fingerprint", "views"}
    for key in settings:
        if key not in known:
            raise UserError(f"Unknown processor setting {brief(key)}. {did_you_mean(str(key), known)}")
    for key in ("image_size", "tokenizer"):
        if key not in settings:
            raise UserError(f"The processor's settings lack {key!r}; they hold {listed(sorted(settings))}.")
    PROMPTS[str(settings.get("prompt", "plain"))]  # a misspelt name is told before any file is read
    fingerprint, stats = settings.pop("tokenizer_fingerprint", None), settings.pop("stats", None)
    if (views := settings.pop("views", OLD_VIEWS)) != OLD_VIEWS:
        raise UserError(f"processor.views={brief(views)}: cameras are named in the section 'embodiment' now.")
    if (robot := settings.pop("embodiment", None)) is not None:
        settings["embodiment"] = Embodiment.from_dict(robot)
    tokenizer = Tokenizer.load(settings.pop("tokenizer"))
    if fingerprint is not None and tokenizer.fingerprint != fingerprint:
        raise UserError(
            f"The tokenizer {tokenizer.spec!r} has fingerprint {tokenizer.fingerprint}, but {brief(fingerprint)} "
            "was used in training: its ids would mean other words. Give the file that was used."
        )
    stats = None if stats is None else NormStats.load(stats)
    return {**settings, "tokenizer": tokenizer, "stats": stats}


def own_settings(folder: Path, tokenizer: Path | str | None) -> dict[str, Any]:
    """What `processor.json` of a checkpoint says, its files found in the folder and compared with their checksums.

    Args:
        tokenizer: in place of the one it names.

    Raises:
        UserError: `folder` holds no processor, or one that names files elsewhere.
    """
    config = read_settings(folder)
    named, stats = config.get("tokenizer", ""), config.get("stats")
    if tokenizer is None:
        tokenizer = own_tokenizer(folder, named)
    if stats is not None:
        stats = own_file(folder, stats, "statistics")
    return {**config, "tokenizer": tokenizer, "stats": stats}


def own_file(folder: Path, name: Any, what: str) -> Path:
    """The path of a file that a checkpoint names in itself, compared with its checksum where there is one."""
    if not isinstance(name, str):
        raise UserError(f"{folder / CONFIG_FILE}: {what}={brief(name)} must be the name of a file.")
    path = inside(folder, name, what)
    check_sums(folder, [name])
    return path


def own_tokenizer(folder: Path, name: Any) -> str | Path:
    """Which tokenizer a checkpoint means: one that ships, a file of its own, or π0.5's on the hub; no other address.

    Raises:
        UserError: it names another file of the hub, which nothing is asked for on a stranger's word.
    """
    if name in (SAMPLE, PALIGEMMA):
        return str(name)
    if isinstance(name, str) and name.startswith(HUB):
        if (folder / TOKENIZER_FILE).is_file():
            return own_file(folder, TOKENIZER_FILE, "tokenizer")
        raise UserError(
            f"{folder} takes its tokenizer from the network, at {brief(name, 200)}, which is not fetched on a "
            f"checkpoint's word. If you trust it: from_pretrained(…, tokenizer={brief(name, 200)}), or download that "
            f"file into the folder as {TOKENIZER_FILE}."
        )
    return own_file(folder, name, "tokenizer")
