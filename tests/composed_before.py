"""Imported by the process that commands are forked from: it has read the library's YAML files once for them all."""

import shared_compositions
from mme_vla.config.composition import compose

shared_compositions.share()
for command in ("train", "evaluate"):
    compose(command, ["model=pi05"])
