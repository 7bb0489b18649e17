"""Which class a configuration's policy is: `policy.name`, a key of the registry."""

import inspect
from collections.abc import Mapping
from typing import Any

from mme_vla.errors import UserError, brief, did_you_mean
from mme_vla.registry import POLICIES

DEFAULT = "mme"
"""The policy of configurations that name none: backbone × memory × integration."""


def policy_name(config: Mapping[str, Any]) -> str:
    """What the section `policy` of a configuration calls its class.

    Raises:
        UserError: the section is no section.
    """
    section = config.get("policy") or {}
    if not isinstance(section, Mapping):
        raise UserError(f"policy={brief(section)} must be a section.")
    return section.get("name", DEFAULT)  # the registry refuses what is no name


def policy_class(config: Mapping[str, Any]) -> type[Any]:
    """The class of the policy that a configuration describes.

    Raises:
        UserError: there is no policy of that name.
    """
    found: type[Any] = POLICIES[policy_name(config)]
    return found


def policy_class_for[P](asked: type[P], config: Mapping[str, Any], source: str) -> type[P]:
    """The class to load a checkpoint with, where `asked.from_pretrained` was called.

    Raises:
        UserError: the checkpoint holds a policy of another class than was asked for.
    """
    kind = policy_class(config)
    if issubclass(asked, kind):
        return asked
    if issubclass(kind, asked):
        return kind
    raise UserError(
        f"{source} holds a {policy_name(config)!r} policy, which is no {asked.__name__}: load it with "
        "Policy.from_pretrained(), which knows every kind."
    )


def policy_options(cls: type, config: Mapping[str, Any]) -> dict[str, Any]:
    """The section `policy`, whose keys beside `name` are the constructor's keyword-only arguments.

    Where a constructor takes `**options`, those of its parent class count too.

    Raises:
        UserError: another key.
    """
    options = {key: value for key, value in config.get("policy", {}).items() if key != "name"}
    known = _keyword_options(cls)
    for key in options:
        if key not in known:
            raise UserError(f"policy has no key {brief(key)}. {did_you_mean(str(key), known)}")
    return options


def _keyword_options(cls: type) -> list[str]:
    known: list[str] = []
    for owner in cls.__mro__:
        if "__init__" in vars(owner):
            parameters = inspect.signature(vars(owner)["__init__"]).parameters.values()
            known += [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
            if not any(p.kind is p.VAR_KEYWORD for p in parameters):
                break
    return list(dict.fromkeys(known))
