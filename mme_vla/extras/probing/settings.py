"""What a probe may be told (`configs/probe.yaml`), checked before PyTorch is imported."""

from collections.abc import Mapping
from typing import Any

from mme_vla.errors import UserError, brief, check_choice, require
from mme_vla.evaluation.rollout.events import event_arms
from mme_vla.evaluation.rollout.settings import check_config
from mme_vla.memory.perturbation import Word, split_word
from mme_vla.registry import PERTURBATIONS

NO_DATA = (
    "A probe on recorded episodes needs some: recordings=<dataset>. Those of the benchmark are made"
    " by `mme-vla record tasks=… episodes=0-9 split=val output=<new folder>`; offline=false"
    " online=true probes in closed loop alone."
)
IN_CLOSED_LOOP = (
    "event=…: events act in closed loop: add online=true to the command, or tasks=… in Python."
)


def check_probe(config: Mapping[str, Any]) -> None:
    """Check rollouts, tasks and checkpoint of a probe, what it is to do, and the names in `with`.

    Args:
        config: plain and resolved.
    """
    if config["compare"] is not None:
        return
    check_config(config)
    if config["twins"]:
        for key in ("card", "online", "recordings", "with", "event", "server", "references"):
            require(
                not config[key],
                f"twins=true measures the policy as it is and without memory: leave out {key}=….",
            )
        return
    in_closed_loop = config["online"] or config["card"]
    is_served = config["server"] is not None
    require(
        config["offline"] or in_closed_loop,
        "offline=false online=false leaves nothing to probe: set one of them to true.",
    )
    require(
        in_closed_loop or not is_served,
        "server=…: a served policy is probed in closed loop alone: add online=true.",
    )
    needs_data = config["offline"] and not config["card"] and not is_served
    require(not needs_data or config["recordings"] is not None, NO_DATA)
    require(config["online"] or not event_arms(config["event"]), IN_CLOSED_LOOP)
    if config["with"] is None:
        return
    for spec in listed_arms(config["with"]):
        if not isinstance(spec, Mapping):
            words_of_arm(spec)


def listed_arms(specs: Any) -> list[Any]:
    """The arms that `with` lists, each a word or a mapping with a name."""
    return [specs] if isinstance(specs, str | Mapping) else list(specs)


def words_of_arm(spec: Any) -> list[tuple[str, Word]]:
    """The perturbations of an arm such as `drop:2` or `nodemo+shuffle`, each with its text.

    Raises:
        UserError: it has another form, or there is no perturbation of a name.
    """
    if not isinstance(spec, str) or not spec:
        raise UserError(
            f"with={brief(spec)}: write words such as drop:2 or nodemo+shuffle, or {{name: drop,"
            " …}."
        )
    words = []
    for text in spec.split("+"):
        word = split_word(text)
        if word is None or word.unit is not None:
            raise UserError(f"with={text}: write a name, as drop, or a name and a number, drop:2.")
        check_choice(f"with={text}: name", word.name, PERTURBATIONS)
        words.append((text, word))
    return words
