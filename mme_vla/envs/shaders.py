"""The shaders of cameras, without a table that these scenes have no use for.

Before a process's first picture SAPIEN computes a table of how rough surfaces reflect an environment map (the split-sum
term of image-based lighting): 6.7 seconds of a processor where software renders, for every process that draws. Scenes
that lamps light have no such map, and its share of a picture is that table times black. The table is made because the
shaders declare it, so here they do not.
"""

import hashlib
import logging
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mani_skill.render import ShaderConfig

PACK = "minimal"
"""ManiSkill's shaders of cameras that observe."""
_TABLE = "samplerBRDFLUT"
_DECLARED = re.compile(rf"^layout\(.*\) uniform sampler2D {_TABLE};$", re.MULTILINE)
_READ = re.compile(rf"texture\({_TABLE}, vec2\([^()]*\)\)\.xy")


def without_table(source: str) -> str:
    """The text of a shader that neither declares nor reads the table; what it said of it is zero."""
    return _DECLARED.sub("", _READ.sub("vec2(0)", source))


def lean_shaders() -> "ShaderConfig | None":
    """Shaders for cameras in scenes without an environment map; None where the installed ones are not as expected.

    Sets the formats of pictures, which ManiSkill sets by the pack's name, so ask right before the cameras are made.
    """
    from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS, set_shader_pack

    folder = _written()
    if folder is None:
        return None
    stock = PREBUILT_SHADER_CONFIGS[PACK]
    set_shader_pack(stock)
    return replace(stock, shader_pack=str(folder))


@cache
def _written() -> Path | None:
    """The folder of changed shaders, made once for an installed SAPIEN."""
    import sapien

    from mme_vla.files import user_cache, write_atomically

    stock = Path(sapien.__file__).parent / "vulkan_shader"
    found = {
        file.relative_to(stock): file.read_text(encoding="utf-8")
        for part in (PACK, "common")
        for file in sorted((stock / part).glob("*"))
        if file.is_file()
    }
    lean = {name: without_table(text) for name, text in found.items()}
    if lean == found or any(_TABLE in text for text in lean.values()):
        logging.getLogger(__name__).debug("these shaders are not known here, and are used as they are: %s", stock)
        return None
    key = hashlib.sha256(repr(sorted(lean.items())).encode()).hexdigest()[:16]
    caches = user_cache("shaders") / key
    for name, text in lean.items():
        if not (caches / name).is_file():
            (caches / name).parent.mkdir(parents=True, exist_ok=True)
            with write_atomically(caches / name) as draft:
                draft.write_text(text, encoding="utf-8")
    return caches / PACK
