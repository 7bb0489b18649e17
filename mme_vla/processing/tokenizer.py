"""Text to token ids with SentencePiece: PaliGemma's model for real weights, a small one of our own
for the sample.
"""

import hashlib
import unicodedata
from importlib.resources import files
from pathlib import Path
from typing import Self

from mme_vla.errors import UserError, brief, require

SAMPLE = "sample"
HUB = "hf://"
_LARGEST = 64 * 2**20  # bytes; PaliGemma's has 4 MiB
PALIGEMMA = "hf://google/paligemma-3b-pt-224/tokenizer.model"  # π0.5's own


class Tokenizer:
    """A SentencePiece model with a beginning-of-sequence token.

    Attributes:
        spec: where it came from, in the words `Tokenizer.load` takes.
        fingerprint: hash of the model file; two tokenizers with the same one give the same ids.
    """

    def __init__(self, model: bytes, spec: str) -> None:
        from sentencepiece import SentencePieceProcessor

        try:
            self._processor = SentencePieceProcessor(model_proto=model)
        except (RuntimeError, TypeError) as error:
            raise UserError(
                f"Tokenizer {spec!r} is not a SentencePiece model file: {error}."
            ) from None
        require(
            self._processor.bos_id() >= 0,
            f"Tokenizer {spec!r} has no beginning-of-sequence token for prompts.",
        )
        self._model = model
        self.spec = spec
        self.fingerprint = hashlib.sha256(model).hexdigest()[:16]

    @classmethod
    def load(cls, spec: str | Path) -> Self:
        """Load a tokenizer.

        Args:
            spec: "sample" for the small model shipped with the library, the path of a `.model`
                file, or "hf://owner/repository/path/in/it.model" for a file on the Hugging Face
                hub.
        """
        spec = str(spec)
        if spec == SAMPLE:
            return cls(files("mme_vla").joinpath("assets/tokenizer.model").read_bytes(), spec)
        path = _download(spec) if spec.startswith(HUB) else Path(spec).expanduser()
        require(
            path.is_file(),
            f"No tokenizer at {brief(spec, 300)}. Give {SAMPLE!r}, the path of a SentencePiece"
            f" .model file, or {HUB}owner/repository/file.model (PaliGemma's:"
            f" {HUB}google/paligemma-3b-pt-224/tokenizer.model).",
        )
        if path.stat().st_size > _LARGEST:
            raise UserError(
                f"{path} has {path.stat().st_size:,} bytes; a tokenizer has at most {_LARGEST:,}."
            )
        return cls(path.read_bytes(), spec)

    @property
    def vocab_size(self) -> int:
        """How many ids there are; the text embedding needs at least as many rows."""
        return self._processor.vocab_size()

    def encode(self, text: str, bos: bool = True) -> list[int]:
        """Turn a text into ids, after the beginning-of-sequence token if `bos`.

        Letters with accents have the same ids whether they are one character or two, as some
        keyboards and systems of files write them.
        """
        return self._processor.encode(unicodedata.normalize("NFC", text), add_bos=bos)

    def piece(self, text: str) -> int:
        """The id of one piece, as the model spells it (`▁` means a space)."""
        index = self._processor.piece_to_id(text)
        require(
            index != self._processor.unk_id(),
            f"Tokenizer {self.spec!r} has no piece {text!r}, which prompts need.",
        )
        return index

    @property
    def end(self) -> int:
        """The id that ends a text."""
        require(
            self._processor.eos_id() >= 0,
            f"Tokenizer {self.spec!r} has no end-of-sequence token for prompts.",
        )
        return self._processor.eos_id()

    def decode(self, ids: list[int]) -> str:
        """Turn ids back into text; special tokens vanish."""
        return self._processor.decode(ids)

    def save(self, path: Path | str) -> None:
        """Write the SentencePiece model file."""
        Path(path).write_bytes(self._model)


def _download(spec: str) -> Path:
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError, LocalEntryNotFoundError

    owner, _, remaining = spec.removeprefix(HUB).partition("/")
    name, _, filename = remaining.partition("/")
    require(
        owner and name and filename,
        f"Tokenizer {spec!r} should read {HUB}owner/repository/path/in/it.model.",
    )
    try:
        return Path(hf_hub_download(f"{owner}/{name}", filename))
    except (HfHubHTTPError, HFValidationError, LocalEntryNotFoundError, OSError) as error:
        raise UserError(
            f"The hub did not give the tokenizer {spec!r} ({type(error).__name__}:"
            f" {str(error).splitlines()[0]}). Check the name, the network and `hf auth login`"
            " (PaliGemma's files ask you to accept a licence), or download the file manually and"
            " give its path."
        ) from None
