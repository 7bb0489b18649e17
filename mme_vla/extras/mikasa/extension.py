"""What the benchmark MIKASA-Robo-VLA adds: names alone."""

from mme_vla.registry import Extension

_MODULE = "mme_vla.extras.mikasa.environment"

EXTENSION = Extension(
    parts={"env": dict.fromkeys(("mikasa", "mikasa_video", "mikasa_choices"), _MODULE)}
)
