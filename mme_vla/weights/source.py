"""What a user points at: which format it is in, and its tensors under that format's names."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from mme_vla.errors import UserError, brief, listed, require
from mme_vla.policy.saving import CONFIG, local_folder, read_config
from mme_vla.policy.tensor_files import INDEX, WEIGHTS, check_header, read_files, weight_files
from mme_vla.registry import WeightFormat, extensions, join_names
from mme_vla.utils import decoding, require_file
from mme_vla.weights.names.jax_memory import ENCODER
from mme_vla.weights.orbax import (
    ARCHIVE_SUFFIX,
    Zipped,
    find_archive,
    find_params,
    leaf_names,
    open_archive,
    read_orbax,
    variant_of,
)
from mme_vla.weights.ports import LEROBOT_PREFIX, from_port, is_port
from mme_vla.weights.torch_files import SUFFIXES, read_torch_file

FORMATS = {
    "ours": "save_pretrained() of this library",
    "lerobot": "LeRobot's pi05 (safetensors)",
    "openpi": "openpi's PyTorch π0.5 (safetensors)",
    "released": "openpi's and MME-VLA's JAX parameter trees (Orbax)",
}


def method_formats() -> dict[str, WeightFormat]:
    """The formats that extensions add, by name."""
    brought = [(extension, extension.weight_formats) for extension in extensions()]
    by_name: dict[str, Any] = join_names("weight format", FORMATS, brought)
    return {name: entry for name, entry in by_name.items() if name not in FORMATS}


def formats() -> dict[str, str]:
    """Name → what it is, of all formats."""
    return FORMATS | {name: of.text for name, of in method_formats().items()}


VARIANTS = {
    "pi05_baseline": "pi05",
    "symbolic-simple-subgoal": "simplesg",
    "symbolic-grounded-subgoal": "groundsg",
    "perceptual-framesamp-context": "framesamp_context",
    "perceptual-framesamp-modul": "framesamp_modul",
    "perceptual-framesamp-expert": "framesamp_expert",
    "perceptual-tokendrop-context": "tokendrop_context",
    "perceptual-tokendrop-modul": "tokendrop_modul",
    "perceptual-tokendrop-expert": "tokendrop_expert",
    "recurrent-rmt-context": "rmt_context",
    "recurrent-rmt-modul": "rmt_modul",
    "recurrent-rmt-expert": "rmt_expert",
    "recurrent-ttt-context": "ttt_context",
    "recurrent-ttt-modul": "ttt_modul",
    "recurrent-ttt-expert": "ttt_expert",
}
"""The released code's names of the variants, and ours."""


@dataclass(frozen=True)
class Source:
    """A checkpoint that was found.

    format: a key of `formats()`.
    folder: what belongs to it lies here: configuration, statistics.
    files: its safetensors files; empty for an Orbax checkpoint.
    params: the Orbax arrays' folder, or their place in an archive.
    base: of a run that holds adapters alone, what they were trained on.
    """

    format: str
    folder: Path
    files: tuple[Path, ...] = ()
    params: Path | Zipped | None = None
    base: "Source | None" = None

    def tensors(
        self, fits: Callable[[Mapping[str, Tensor]], None] | None = None
    ) -> dict[str, Tensor]:
        """Read all tensors, under the one spelling that the format's name table knows.

        Args:
            fits: where reading takes memory (Orbax), called before with tensors of the same names
                and shapes on meta; raises where they do not fit.
        """
        if self.params is not None:
            return read_orbax(self.params, fits)
        method = method_formats().get(self.format)
        tensors: dict[str, Tensor]
        if method is not None and method.native is not None:
            file = self.files[0]
            tensors = method.function("native")(read_torch_file(file), str(file))
        elif method is not None and self.base is not None:
            tensors = method.function("merge")(self.base.tensors(), self.folder)
        else:
            tensors = read_files(self.folder, self.files)
            if self.format in ("lerobot", "openpi"):
                tensors = from_port(tensors, str(self.folder))
            elif method is not None and method.spelling is not None:
                tensors = method.function("spelling")(tensors, self.folder)
        return tensors

    @property
    def label(self) -> str:
        """The checkpoint's place, for messages."""
        if isinstance(self.params, Zipped):
            return str(self.params)
        return str(self.folder)

    @property
    def config(self) -> dict[str, Any]:
        """What `config.json` beside the weights says; empty without one."""
        if not (self.folder / CONFIG).is_file():
            return {}
        return read_config(self.folder)

    @cached_property
    def variants(self) -> list[str]:
        """Our names of the variants that a checkpoint may be; none where it does not say.

        A word in `history_config.txt` that is no variant of the released code never becomes part of
        a configuration: the names of the tensors tell the variant.
        """
        if self.format in method_formats():
            return [method_formats()[self.format].model or self.format]
        if self.params is None:
            return []
        place = self.params.file if isinstance(self.params, Zipped) else self.params
        parents = [place.parent, place.parent.parent]
        variant = variant_of([self.folder, *parents])
        if variant in VARIANTS:
            return [VARIANTS[variant]]
        if variant is not None:
            return _variants_with(leaf_names(self.params), variant)
        for parent in parents:  # published runs lie in folders that have the variant's name
            if parent.name in VARIANTS:
                return [VARIANTS[parent.name]]
        return []

    @property
    def lacks_positions(self) -> bool:
        """Whether a released memory was trained without position features
        (`use_pos_emb: false`).
        """
        if self.params is None:
            return False
        leaves = leaf_names(self.params)
        has_encoder = any(leaf.startswith(ENCODER) for leaf in leaves)
        return has_encoder and f"{ENCODER}/pos_proj/kernel" not in leaves


def _variants_with(leaves: Collection[str], variant: str) -> list[str]:
    """Our names of the released variants whose trees have such leaves.

    The tensors of FrameSamp and TokenDrop have the same names. Where `variant`, the name in
    `history_config.txt`, has neither in it, it is one of both.
    """

    def has(part: str) -> bool:
        return any(part in leaf for leaf in leaves)

    if not has(ENCODER):
        return ["pi05", "simplesg", "groundsg"]
    if has("/mem_attn/"):
        integration = "modul"
    elif has("final_norm_mem"):
        integration = "expert"
    else:
        integration = "context"
    if has("recur_layer/W1"):
        memories = ["ttt"]
    elif has("recur_layer/memory_state"):
        memories = ["rmt"]
    else:
        perceptual = ["framesamp", "tokendrop"]
        memories = [name for name in perceptual if name in variant] or perceptual
    return [f"{memory}_{integration}" for memory in memories]


def open_source(
    source: str | Path,
    revision: str | None = None,
    token: str | None = None,
    base: str | Path | None = None,
) -> Source:
    """Find a checkpoint: a folder, a safetensors file, an Orbax run or step, an archive of one, or
    a place on the hub.

    On the hub: `owner/name`, or `owner/name/folder/in/it`.

    Args:
        base: for a run that holds adapters alone, what they were trained on. What the run itself
            names is not fetched.
    """
    path = local_folder(source, revision, token)
    require(path.exists(), f"No checkpoint at {path}: there is no such file or folder.")
    if not path.is_dir():
        require_file(path, "a checkpoint")
    is_local = path.is_file() or (path / WEIGHTS).is_file() or (path / INDEX).is_file()
    if base is not None:
        adapters = _adapters_in(path)
        if is_local or adapters is None:
            raise UserError(
                f"base={str(base)!r} is for a run that holds adapters alone; {path} does not: leave"
                " it out."
            )
        base_source = open_source(base)
        require(
            base_source.format == adapters.format,
            f"base={str(base)!r} is {formats()[base_source.format]}; the adapters in {path} belong"
            f" to {formats()[adapters.format]}.",
        )
        return Source(adapters.format, path, base=base_source)
    if path.is_file() and path.suffix in SUFFIXES:
        return _of_torch_file(path)
    if path.is_file() and path.suffix == ARCHIVE_SUFFIX:
        return _of_archive(path)
    if path.is_file():
        return _of_files(path.parent, (path,))
    params = find_params(path)
    if (path / WEIGHTS).is_file() or (path / INDEX).is_file():
        require(
            params is None,
            f"{path} holds two sets of weights: safetensors, and Orbax arrays in {params}. Which"
            " are meant is not known: name the file or folder of one of them, or remove the"
            " other.",
        )
        return _of_files(path, tuple(weight_files(path)))
    if params is not None:
        folder = params.parent if params.name == "params" else params
        return Source("released", folder, params=params)
    zipped = find_archive(path)
    if zipped is not None:
        return _of_archive(zipped)
    adapters = _adapters_in(path)
    if adapters is not None:
        raise UserError(
            f"{path} holds adapters apart from what they were trained on"
            f" ({brief(adapters.base)}): name it, load_weights(policy, run, base=…), or mme-vla"
            " weights <run> <new folder> --base …"
        )
    files = sorted(file for file in path.iterdir() if file.suffix in SUFFIXES and file.is_file())
    if len(files) == 1:
        return _of_torch_file(files[0])
    require(
        not files, f"{path} holds {listed(file.name for file in files)}: name the one you mean."
    )
    if (path / "adapter_model.safetensors").is_file():
        raise UserError(
            f"{path} holds a PEFT adapter alone, not a policy: merge it into its base model first."
        )
    raise UserError(
        f"{path} holds no checkpoint of a known kind. Known: {'; '.join(formats().values())}."
    )


class _Adapters(NamedTuple):
    format: str
    base: str


def _adapters_in(folder: Path) -> _Adapters | None:
    """The format of a run's adapters, which lie apart from their base, and that base's name."""
    for name, method in method_formats().items():
        if method.named_base is not None:
            base = method.function("named_base")(folder)
            if base is not None:
                return _Adapters(name, base)
    return None


def _of_archive(file: Path) -> Source:
    params, folder = open_archive(file)
    return Source("released", folder, params=params)


def _of_files(folder: Path, files: tuple[Path, ...]) -> Source:
    from safetensors import safe_open

    names = []
    for file in files:
        check_header(file)
        with (
            decoding(file, "a safetensors file", "Download or copy it again."),
            safe_open(file, "pt") as opened,
        ):
            names += list(opened.keys())
    if is_port(names):
        is_prefixed = any(name.startswith(LEROBOT_PREFIX) for name in names)
        is_lerobot = is_prefixed or "type" in Source("lerobot", folder).config
        return Source("lerobot" if is_lerobot else "openpi", folder, files)
    # Not every kind of policy has a backbone among its modules; each has one in its configuration.
    if "backbone" in Source("ours", folder).config:
        return Source("ours", folder, files)
    for name, method in method_formats().items():
        if method.native is None and method.function("matches")(names):
            return Source(name, folder, files)
    if any(name.startswith("backbone.") for name in names):
        return Source("ours", folder, files)
    if any(name.startswith("PaliGemma/") for name in names):
        return Source("released", folder, files)
    few = listed(sorted(names), 3) or "none at all"
    raise UserError(
        f"{files[0]} is no policy of a known kind: its tensors are called {few}. Known:"
        f" {'; '.join(formats().values())}."
    )


def _of_torch_file(path: Path) -> Source:
    names = list(read_torch_file(path, mapped=True))
    known = [name for name, method in method_formats().items() if method.native]
    for name in known:
        if method_formats()[name].function("matches")(names):
            return Source(name, path.parent, (path,))
    few = listed(sorted(names), 3)
    raise UserError(
        f"{path} holds no policy known here: its tensors are called {few}. Known:"
        f" {', '.join(known)}."
    )
