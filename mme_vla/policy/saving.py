"""What a policy needs to write itself to a folder or the hub, and to come back."""

import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import nn

from mme_vla.errors import UserError
from mme_vla.policy.card import CARD_FILE, model_card
from mme_vla.policy.finetune import add_adapters
from mme_vla.policy.hub import local_folder, push_folder
from mme_vla.policy.tensor_files import assign_tensors, dtype_of, load_tensors, save_tensors

if TYPE_CHECKING:
    from mme_vla.processing.processor import Processor

CONFIG = "config.json"


class Saved(nn.Module):
    """A module that is built from a configuration and keeps a processor beside it."""

    config: dict[str, Any]
    processor: "Processor | None"

    @classmethod
    def from_config(cls, config: Mapping[str, Any], processor: "Processor | None" = None) -> Self:
        """Build from plain sections."""
        raise NotImplementedError

    def save_pretrained(
        self, folder: str | Path, *, dtype: str = "float32", card: Mapping[str, Any] | None = None
    ) -> None:
        """Write weights, configuration, normalisation statistics and tokenizer; `from_pretrained` needs no more.

        Args:
            dtype: what the weights are stored in: `float32`, or `bfloat16` at half the size and eight bits of mantissa.
            card: facts for the model card, kept in the configuration: `data` (words), `recipe`, `results` (tables).

        Raises:
            UserError: an unknown dtype.
        """
        kind, folder = dtype_of(dtype), Path(folder)
        if card is not None:
            self.config["card"] = {**self.config.get("card", {}), **card}
        save_tensors(self.state_dict(), folder, dtype=kind)
        (folder / CONFIG).write_text(json.dumps(self.config, indent=2, ensure_ascii=False) + "\n")
        (folder / CARD_FILE).write_text(model_card(self, self.config))
        if self.processor is not None:
            self.processor.save(folder)

    @classmethod
    def from_pretrained(
        cls,
        source: str | Path,
        *,
        device: str | torch.device = "cpu",
        dtype: str = "float32",
        revision: str | None = None,
        token: str | None = None,
        **policy: Any,
    ) -> Self:
        """Load what `save_pretrained` wrote; of a training checkpoint, the EMA weights. No weight is drawn first.

        Args:
            source: a folder on disk, or `owner/name` of a hub repository.
            device: where to put the weights.
            dtype: what the weights become. `bfloat16` halves the memory, for inference; compute is then bfloat16 too.
            revision: branch, tag or commit of the repository. token: for private repositories.
            policy: overrides of the `policy` section, such as `compute_dtype="bfloat16"`.

        Raises:
            UserError: no checkpoint there, a damaged file, or weights that do not fit the configuration.
        """
        from mme_vla.processing.processor import Processor

        kind, folder = dtype_of(dtype), local_folder(source, revision, token)
        if not (folder / CONFIG).is_file():
            raise UserError(f"No policy at {source}: expected a folder with {CONFIG}, as save_pretrained() writes.")
        try:
            config = json.loads((folder / CONFIG).read_text())
        except ValueError as error:
            raise UserError(f"{folder / CONFIG} is not valid JSON: {error}") from error
        if not isinstance(config, dict) or "backbone" not in config:
            raise UserError(
                f"{folder / CONFIG} is not this library's: it lacks the section 'backbone'. Weights of other formats "
                "are read by mme_vla.weights.load_weights() and converted by python -m mme_vla.weights.convert."
            )
        if dtype == "bfloat16":
            policy = {"compute_dtype": "bfloat16", **policy}
        config["policy"] = {**config.get("policy", {}), **policy}
        with torch.device("meta"):
            loaded = cls.from_config(config)
            if config.get("adapters"):
                add_adapters(loaded, **config["adapters"])
        assign_tensors(loaded, load_tensors(folder), str(source), kind)
        loaded.processor = Processor.load(folder)
        return loaded.to(device).eval()

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
