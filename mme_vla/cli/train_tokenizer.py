"""Train the small tokenizer that the library ships: `mme-vla train-tokenizer [folder]`.

Its corpus (`mme_vla/assets/tokenizer_corpus.txt`) is the language of RoboMME: the goals and
subgoals of the 16 tasks with their colours, counts and ordinals, the prompts' own words, the
numbers 0…255 and image points. The settings are those of PaliGemma's tokenizer wherever they touch
behaviour: the same special ids, single digits, bytes for unknown characters, and text taken as it
stands (no prefix, no case folding, spaces and newlines kept). Training is deterministic.
"""

import io
import string
from collections.abc import Iterable, Sequence
from importlib.resources import files
from pathlib import Path

from mme_vla.cli.help import argument_parser
from mme_vla.errors import UserError, require
from mme_vla.utils import write_atomically

VOCAB_SIZE = 1024


def train_tokenizer(sentences: Iterable[str]) -> bytes:
    """Return a SentencePiece model of `VOCAB_SIZE` pieces made from these sentences."""
    from sentencepiece import SentencePieceTrainer

    model = io.BytesIO()
    try:
        SentencePieceTrainer.train(
            sentence_iterator=iter(sentences),
            model_writer=model,
            model_type="bpe",
            vocab_size=VOCAB_SIZE,
            pad_id=0,
            eos_id=1,
            bos_id=2,
            unk_id=3,
            byte_fallback=True,
            split_digits=True,
            add_dummy_prefix=False,
            remove_extra_whitespaces=False,
            normalization_rule_name="identity",
            user_defined_symbols=["\n"],
            required_chars="".join(sorted(set(string.printable) - set(string.whitespace))),
            character_coverage=1.0,
            num_threads=1,
            minloglevel=2,
        )
    except RuntimeError as error:
        raise UserError(f"Could not train a tokenizer of {VOCAB_SIZE} pieces: {error}.") from None
    return model.getvalue()


def read_corpus() -> list[str]:
    """Return the sentences of the shipped corpus."""
    return (
        files("mme_vla")
        .joinpath("assets/tokenizer_corpus.txt")
        .read_text(encoding="utf-8")
        .splitlines()
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Train on the shipped corpus and write `tokenizer.model` into a folder."""
    parser = argument_parser(
        "mme-vla train-tokenizer", str(__doc__).partition("\n")[0], ("", "outputs/tokenizer")
    )
    parser.add_argument(
        "folder",
        nargs="?",
        type=Path,
        default=Path(),
        help="where to write tokenizer.model (default: here)",
    )
    path = parser.parse_args(arguments).folder / "tokenizer.model"
    content = train_tokenizer(read_corpus())
    require(
        not path.exists() or path.read_bytes() == content,
        f"{path} exists, and is another tokenizer, which a checkpoint or a training may need:"
        " choose another folder, or remove it yourself.",
    )
    with write_atomically(path) as draft:
        draft.write_bytes(content)
    print(f"Wrote {path} ({VOCAB_SIZE} pieces).")
