"""Folders that live on the Hugging Face Hub: found by `owner/name`, and written there."""

import re
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError
from mme_vla.policy.run_folders import newest_checkpoint

_REPOSITORY = re.compile(r"[A-Za-z0-9][\w.-]*/[\w.-]+")
_PLACE = re.compile(rf"({_REPOSITORY.pattern})((?:/[\w-][\w. -]*)*)")
"""A repository, and a folder or file in it."""


def local_folder(source: str | Path, revision: str | None = None, token: str | None = None) -> Path:
    """Return `source` if it exists on disk, else the downloaded snapshot of the hub repository of that name.

    A folder of a training run stands for its newest checkpoint, and `latest` for the newest run beside it.

    Args:
        source: a path, or `owner/name` of a hub repository, or `owner/name/folder` of one in it: no other is fetched.
        revision: branch, tag or commit of the repository; its main branch by default.
        token: for private repositories; the one stored by `hf auth login` by default.

    Raises:
        UserError: neither a path nor a repository that can be reached.
    """
    path = newest_checkpoint(Path(source).expanduser())
    place = _PLACE.fullmatch(str(source))
    if path.exists() or place is None:
        if revision is not None:
            raise UserError(f"revision={revision!r} names a state of a hub repository, but {source} is a path.")
        return path
    import httpx
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled

    repository, within = place[1], place[2].strip("/")
    try:
        if not within:
            return Path(snapshot_download(repository, revision=revision, token=token))
        wanted = [within, f"{within}/*"]
        root = Path(snapshot_download(repository, revision=revision, token=token, allow_patterns=wanted))
        if not (root / within).exists():
            raise UserError(f"The hub repository {repository} has no {within!r}: nothing of that name was in it.")
        return root / within
    except (HfHubHTTPError, LocalEntryNotFoundError, OfflineModeIsEnabled, httpx.HTTPError, OSError) as error:
        at = "" if revision is None else f" at revision {revision!r}"
        reason = str(error).strip().splitlines()
        raise UserError(
            f"{source} is not a path on this machine, and the hub repository of that name{at} could not be fetched "
            f"({type(error).__name__}: {reason[0] if reason else 'no answer'}). Check the name, the network, and for a "
            "private or gated repository your token (hf auth login)."
        ) from error


def push_folder(
    folder: Path, repo_id: str, *, private: bool, token: str | None, revision: str | None, message: str
) -> str:
    """Create the repository if need be, upload the folder's files as one commit, and return its address.

    Raises:
        UserError: the id is not `owner/name`, or the hub refuses.
    """
    if not _REPOSITORY.fullmatch(repo_id):
        raise UserError(f"repo_id={repo_id!r} must read owner/name, such as my-group/framesamp-modul.")
    import huggingface_hub
    from huggingface_hub.errors import HfHubHTTPError

    api: Any = huggingface_hub.HfApi(token=token)
    try:
        address = api.create_repo(repo_id, private=private, exist_ok=True)
        if revision is not None:
            api.create_branch(repo_id, branch=revision, exist_ok=True)
        api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=message, revision=revision)
    except HfHubHTTPError as error:
        raise UserError(f"The hub refused to store {repo_id}: {error}. Is the token allowed to write there?") from error
    return str(address)
