"""Imported by the process that commands are forked from: it has read the library's YAML files once for them all."""

from mme_vla.config.composition import compose

for command in ("train", "evaluate"):
    compose(command, ["model=pi05"])
