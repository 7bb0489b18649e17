"""The shipped tokenizer knows RoboMME's language; others load by path or from the hub, or fail
clearly.
"""

import unicodedata
from pathlib import Path

import huggingface_hub
import pytest
from huggingface_hub.errors import LocalEntryNotFoundError

from mme_vla.cli.train_tokenizer import VOCAB_SIZE, read_corpus, train_tokenizer
from mme_vla.errors import UserError
from mme_vla.processing.tokenizer import Tokenizer


@pytest.fixture(scope="module")
def tokenizer() -> Tokenizer:
    return Tokenizer.load("sample")


def test_special_ids_are_those_of_paligemma(tokenizer: Tokenizer) -> None:
    processor = tokenizer._processor
    assert [processor.pad_id(), processor.eos_id(), processor.bos_id(), processor.unk_id()] == [
        0,
        1,
        2,
        3,
    ]
    assert tokenizer.encode("press") == [2, *tokenizer.encode("press", bos=False)]


@pytest.mark.parametrize(
    "text",
    [
        "\n",
        "Task: press the button;\nCurrent Subgoal: put it down;\nAction: ",
        "  two  spaces, a\ttab ",
        "Ünïcode 🤖 at <12, 200>",
    ],
)
def test_every_text_survives_the_round_trip(tokenizer: Tokenizer, text: str) -> None:
    ids = tokenizer.encode(text)
    assert 3 not in ids
    assert tokenizer.decode(ids) == text


def test_accents_of_one_character_and_of_two_have_the_same_ids(tokenizer: Tokenizer) -> None:
    text = "Größe: plier la serviette d'été"
    apart = unicodedata.normalize("NFD", text)
    assert apart != text
    assert tokenizer.encode(apart) == tokenizer.encode(text)


def test_training_on_the_shipped_corpus_gives_the_shipped_model(tokenizer: Tokenizer) -> None:
    again = Tokenizer(train_tokenizer(read_corpus()), "again")
    assert tokenizer.vocab_size == again.vocab_size == VOCAB_SIZE
    pieces = [t._processor.id_to_piece(list(range(VOCAB_SIZE))) for t in (tokenizer, again)]
    assert pieces[0] == pieces[1]


def test_a_model_loads_by_path_with_the_same_fingerprint(
    tokenizer: Tokenizer, tmp_path: Path
) -> None:
    tokenizer.save(tmp_path / "own.model")
    loaded = Tokenizer.load(tmp_path / "own.model")
    assert loaded.fingerprint == tokenizer.fingerprint and loaded.spec == str(
        tmp_path / "own.model"
    )


def test_a_missing_file_is_named_with_the_alternatives() -> None:
    with pytest.raises(UserError, match=r"nowhere\.model.*'sample'.*hf://"):
        Tokenizer.load("nowhere.model")


def test_a_foreign_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "foreign.model").write_bytes(b"not a model")
    with pytest.raises(UserError, match="not a SentencePiece model"):
        Tokenizer.load(tmp_path / "foreign.model")


def test_hub_ids_are_split_into_repository_and_file(
    tokenizer: Tokenizer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests = []
    tokenizer.save(tmp_path / "t.model")

    def download(repository: str, filename: str) -> str:
        requests.append((repository, filename))
        return str(tmp_path / "t.model")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    assert Tokenizer.load("hf://owner/repo/sub/t.model").spec == "hf://owner/repo/sub/t.model"
    assert requests == [("owner/repo", "sub/t.model")]


def test_an_unreachable_hub_is_a_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def download(repository: str, filename: str) -> str:
        raise LocalEntryNotFoundError("offline mode is enabled")

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    with pytest.raises(UserError, match=r"offline mode is enabled.*give its path"):
        Tokenizer.load("hf://owner/repo/t.model")


def test_a_hub_id_without_a_file_is_refused() -> None:
    with pytest.raises(UserError, match="owner/repository"):
        Tokenizer.load("hf://owner/repo")
