"""Our own format: dtype, shards, the model card, and the hub (through a stand-in)."""

import json
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import torch
from huggingface_hub.errors import LocalEntryNotFoundError
from safetensors.torch import load_file

from mme_vla import MMEPolicy, UserError
from mme_vla.policy.tensor_files import load_tensors, save_tensors
from mme_vla.testing.small import random_batch, small_policy
from mme_vla.weights import load_weights


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return small_policy("framesamp_modul")


def test_bfloat16_files_are_half_as_large_and_load_in_either_dtype(
    policy: MMEPolicy, tmp_path: Path
) -> None:
    policy.save_pretrained(tmp_path / "full")
    policy.save_pretrained(tmp_path / "half", dtype="bfloat16")
    full, half = (tmp_path / name / "model.safetensors" for name in ("full", "half"))
    assert half.stat().st_size < 0.55 * full.stat().st_size
    assert {tensor.dtype for tensor in load_file(half).values()} == {torch.bfloat16}
    batch = random_batch(policy)
    noise = torch.randn(batch.actions.shape, generator=torch.Generator().manual_seed(1))
    exact = policy.sample_actions(batch, noise)
    for dtype, kind in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
        loaded = MMEPolicy.from_pretrained(tmp_path / "half", dtype=dtype)
        assert {p.dtype for p in loaded.parameters()} == {kind}
        assert loaded.compute_dtype == kind
        assert (loaded.sample_actions(batch, noise) - exact).norm() / exact.norm() < 0.05
    with pytest.raises(UserError, match=r"float16.*bfloat16, float32"):
        policy.save_pretrained(tmp_path / "x", dtype="float16")


def test_large_weights_are_sharded_and_read_back(policy: MMEPolicy, tmp_path: Path) -> None:
    save_tensors(policy.state_dict(), tmp_path, max_shard_size="500KB")
    assert len(list(tmp_path.glob("model-*.safetensors"))) > 2
    back = load_tensors(tmp_path)
    assert all(torch.equal(back[name], tensor) for name, tensor in policy.state_dict().items())


def test_the_card_says_what_is_known_and_what_is_not(tmp_path: Path) -> None:
    policy = small_policy("tokendrop_expert")
    policy.save_pretrained(tmp_path / "bare")
    bare = (tmp_path / "bare" / "README.md").read_text()
    assert bare.startswith("---\nlibrary_name: mme-vla\n")
    assert "tokendrop (budget 512" in bare
    assert bare.count("Not recorded.") == 3
    facts = {
        "data": "RoboMME, 16 tasks",
        "recipe": {"steps": 80000, "batch": 64},
        "results": {"mean success": "44.5 %"},
    }
    policy.save_pretrained(tmp_path / "known", card=facts)
    again = MMEPolicy.from_pretrained(tmp_path / "known")
    again.save_pretrained(tmp_path / "again")
    card = (tmp_path / "again" / "README.md").read_text()
    assert all(
        words in card
        for words in ("RoboMME, 16 tasks", "| steps | 80000 |", "| mean success | 44.5 % |")
    )


class StandInHub:
    """What `HfApi` is asked to do, on a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.calls = folder, []

    def __call__(self, token: str | None = None) -> "StandInHub":
        self.calls.append(("login", token))
        return self

    def create_repo(self, repo_id: str, *, private: bool, exist_ok: bool) -> str:
        self.calls.append(("create", repo_id, private, exist_ok))
        return f"https://hub/{repo_id}"

    def create_branch(self, repo_id: str, *, branch: str, exist_ok: bool) -> None:
        self.calls.append(("branch", branch))

    def upload_folder(
        self, *, repo_id: str, folder_path: Path, commit_message: str, revision: str | None
    ) -> None:
        self.calls.append(("upload", repo_id, commit_message, revision))
        Path(folder_path).rename(self.folder / "repository")
        Path(folder_path).mkdir()


def test_push_and_load_by_name(
    policy: MMEPolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hub = StandInHub(tmp_path)
    monkeypatch.setattr(huggingface_hub, "HfApi", hub)
    address = policy.push_to_hub(
        "group/modul", private=True, token="secret", revision="v1", message="first"
    )
    assert address == "https://hub/group/modul"
    assert hub.calls == [
        ("login", "secret"), ("create", "group/modul", True, True), ("branch", "v1"),
        ("upload", "group/modul", "first", "v1"),
    ]  # fmt: skip
    calls: dict[str, Any] = {}

    def snapshot(repo_id: str, **options: Any) -> str:
        calls.update(options, repo_id=repo_id)
        return str(tmp_path / "repository")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot)
    loaded = MMEPolicy.from_pretrained("group/modul", revision="v1", token="secret")
    assert calls == {"repo_id": "group/modul", "revision": "v1", "token": "secret"}
    assert all(
        torch.equal(tensor, loaded.state_dict()[name])
        for name, tensor in policy.state_dict().items()
    )
    load_weights(small_policy("framesamp_modul"), "group/modul")
    with pytest.raises(UserError, match="owner/name"):
        policy.push_to_hub("no-owner")


def test_without_network_the_sentence_names_the_repository(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def offline(repo_id: str, **options: Any) -> str:
        raise LocalEntryNotFoundError("no connection")

    monkeypatch.setattr(huggingface_hub, "snapshot_download", offline)
    with pytest.raises(
        UserError, match=r"group/modul is not a path.*revision 'v2'.*no connection.*hf auth login"
    ):
        MMEPolicy.from_pretrained("group/modul", revision="v2")
    with pytest.raises(UserError, match="names a state of a hub repository"):
        MMEPolicy.from_pretrained(tmp_path, revision="v2")


def test_a_folder_of_another_library_is_sent_to_the_converter(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"type": "pi05"}))
    with pytest.raises(UserError, match="mme-vla weights"):
        MMEPolicy.from_pretrained(tmp_path)
