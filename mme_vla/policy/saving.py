"""What a policy needs to write itself to a folder or the hub, and to come back."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import torch
from torch import Tensor, nn

from mme_vla.backbone.shapes_only import shapes_only
from mme_vla.config.plugins import import_trusted
from mme_vla.errors import UserError, brief
from mme_vla.files import check_sums, inside, read_json, write_sums
from mme_vla.policy.card import CARD_FILE, model_card
from mme_vla.policy.finetune import add_adapters
from mme_vla.policy.hub import local_folder, push_folder
from mme_vla.policy.kinds import policy_class_for
from mme_vla.policy.tensor_files import assign_tensors, dtype_of, load_tensors, save_tensors, written_weights

if TYPE_CHECKING:
    from mme_vla.processing.base import PolicyProcessor

CONFIG = "config.json"


def read_config(folder: Path) -> dict[str, Any]:
    """Read `config.json` of a checkpoint, as plain values: nothing in it is resolved or imported.

    Raises:
        UserError: it is missing, damaged, or a link out of the folder.
    """
    path = inside(folder, CONFIG)
    check_sums(folder, [CONFIG])
    config: dict[str, Any] = read_json(path, "a policy's configuration", limit=2**20)
    return config


class Saved(nn.Module):
    """A module that is built from a configuration and keeps a processor beside it."""

    config: dict[str, Any]
    processor: "PolicyProcessor | None"
    acts_in_bfloat16: ClassVar[bool] = False
    """Whether `dtype="auto"` rounds its weights to bfloat16 on a GPU."""

    @classmethod
    def from_config(
        cls, config: Mapping[str, Any], processor: "PolicyProcessor | None" = None, *, fresh_backbone: bool = True
    ) -> Self:
        """Build from plain sections."""
        raise NotImplementedError

    def save_pretrained(
        self, folder: str | Path, *, dtype: str = "float32", card: Mapping[str, Any] | None = None
    ) -> None:
        """Write weights, configuration, normalisation statistics and tokenizer; `from_pretrained` needs no more.

        `SHA256SUMS` beside them holds a checksum of each, which loading compares.

        Args:
            dtype: what the weights are stored in: `float32`, or `bfloat16` at half the size and eight bits of mantissa.
            card: facts for the model card, kept in the configuration: `data` (words), `recipe`, `results` (tables),
                `license`, `base_model`, `datasets` (ids on the hub).

        Raises:
            UserError: an unknown dtype.
        """
        kind, folder = dtype_of(dtype), Path(folder)
        if card is not None:
            self.config["card"] = {**self.config.get("card", {}), **card}
        save_tensors(self.state_dict(), folder, dtype=kind)
        about = self.save_about(folder)
        write_sums(folder, [*about, *written_weights(folder)])  # not of the card, which people edit

    def save_about(self, folder: Path) -> list[str]:
        """Write all that `save_pretrained` writes beside the weights; return the names of what has checksums."""
        (folder / CONFIG).write_text(json.dumps(self.config, indent=2, ensure_ascii=False) + "\n")
        (folder / CARD_FILE).write_text(model_card(self, self.config))
        return [CONFIG, *(self.processor.save(folder) if self.processor is not None else [])]

    @classmethod
    def from_pretrained(
        cls,
        source: str | Path,
        *,
        device: str | torch.device = "cpu",
        dtype: str = "float32",
        revision: str | None = None,
        token: str | None = None,
        trust_plugins: bool = False,
        tokenizer: str | Path | None = None,
        **policy: Any,
    ) -> Self:
        """Load what `save_pretrained` wrote; of a training checkpoint, the EMA weights. No weight is drawn first.

        `Policy.from_pretrained` loads every kind of policy, a subclass its own.

        Args:
            source: a folder on disk (of a checkpoint, or of a run: then its newest; `…/latest`: of the newest run), or
                `owner/name` of a hub repository.
            device: where to put the weights.
            dtype: what the weights become. `bfloat16` halves the memory, for inference: compute is then bfloat16 too,
                and no weight asks for a gradient. `auto`: bfloat16 on a GPU if the policy is made for it, else float32.
            revision: branch, tag or commit of the repository. token: for private repositories.
            trust_plugins: import the modules that the checkpoint names under `plugins`: code of whoever wrote it.
            tokenizer: in place of the one the checkpoint names, which is fetched from the hub only if it is π0.5's own.
            policy: overrides of the `policy` section, such as `compute_dtype="bfloat16"`.

        Raises:
            UserError: no checkpoint there, one of another kind of policy, a damaged file, a name that leads out of
                the folder, plugins that are not trusted, or weights that do not fit the configuration.
        """
        from mme_vla.processing.base import load_processor

        wanted, folder = None if dtype == "auto" else dtype_of(dtype), local_folder(source, revision, token)
        if not (folder / CONFIG).is_file():
            raise UserError(f"No policy at {source}: expected a folder with {CONFIG}, as save_pretrained() writes.")
        config = read_config(folder)
        if "backbone" not in config:
            raise UserError(
                f"{folder / CONFIG} is not this library's: it lacks the section 'backbone'. Weights of other formats "
                "are read by mme_vla.weights.load_weights() and converted by python -m mme_vla.weights.convert."
            )
        import_trusted(config, str(source), trust_plugins)
        chosen = policy_class_for(cls, config, str(source))
        on_gpu = torch.device(device).type == "cuda"
        kind = wanted or (torch.bfloat16 if on_gpu and chosen.acts_in_bfloat16 else torch.float32)
        if kind == torch.bfloat16:
            policy = {"compute_dtype": "bfloat16", **policy}
        loaded = chosen.from_saved(config, str(folder / CONFIG), policy)
        assign_tensors(loaded, load_tensors(folder), str(source), kind)
        loaded.compute_unsaved()
        loaded.processor = load_processor(folder, tokenizer)
        loaded.check_processor(str(source))
        if kind == torch.bfloat16:
            loaded.requires_grad_(False)
        return loaded.to(device).eval()

    @classmethod
    def from_saved(cls, config: dict[str, Any], source: str, policy: Mapping[str, Any] | None = None) -> Self:
        """Build what a checkpoint's configuration describes, on meta, adapters included.

        Args:
            config: plain sections. source: where they are from, for messages.
            policy: overrides of its section `policy`.

        Raises:
            UserError: they describe nothing that can be built.
        """
        given = config.get("policy", {})
        if not isinstance(given, dict):
            raise UserError(f"{source}: policy={brief(given)} must be a section.")
        config = {**config, "policy": {**given, **(policy or {})}}
        try:
            with shapes_only():
                built = cls.from_config(config)
                if config.get("adapters"):
                    add_adapters(built, **config["adapters"])  # type: ignore[arg-type]  # whoever is saved is a Policy
        except UserError as error:
            raise UserError(f"{source}: {error}") from error
        except Exception as error:
            if config.get("plugins"):
                raise  # it may be in the user's own code
            reason = brief(f"{type(error).__name__}: {error}", 300, quote=False)
            raise UserError(
                f"{source} describes no policy that can be built ({reason}). It is damaged, or of a newer version."
            ) from error
        return built

    def compute_unsaved(self) -> None:
        """Give tensors that constructors compute, and no file holds, their values, where they were built on meta.

        Such are buffers registered with `persistent=False`, and tensors kept as plain attributes.
        """
        places = [
            (path, name)
            for path, module in self.named_modules()
            for name, value in [*module.named_buffers(recurse=False), *vars(module).items()]
            if isinstance(value, Tensor) and value.is_meta
        ]
        if not places:
            return
        fresh = any(path.startswith("backbone") for path, _ in places)
        with torch.random.fork_rng(devices=[]):
            real = type(self).from_config(self.config, fresh_backbone=fresh)
        for path, name in places:
            value = getattr(real.get_submodule(path), name)
            setattr(self.get_submodule(path), name, value)

    def check_processor(self, source: str) -> None:
        """Make sure that the network and its processor speak of the same sizes.

        Raises:
            UserError: they do not.
        """
        raise NotImplementedError

    def push_to_hub(
        self,
        repo_id: str,
        *,
        private: bool = False,
        token: str | None = None,
        revision: str | None = None,
        message: str = "Upload policy",
        dtype: str = "float32",
        card: Mapping[str, Any] | None = None,
    ) -> str:
        """Store the policy on the Hugging Face Hub, as `save_pretrained` writes it.

        Args:
            repo_id: `owner/name`; created if it does not exist. private: only if it is created now.
            token: a write token; the one stored by `hf auth login` by default.
            revision: the branch to commit to. message: of the commit. dtype, card: as for `save_pretrained`.

        Returns:
            The repository's address.

        Raises:
            UserError: the id is malformed, or the hub refuses.
        """
        with tempfile.TemporaryDirectory() as folder:
            self.save_pretrained(folder, dtype=dtype, card=card)
            return push_folder(Path(folder), repo_id, private=private, token=token, revision=revision, message=message)
