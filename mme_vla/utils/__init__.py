"""Files as they really are: damaged, shared, half written, from strangers. Nothing here knows what is in them."""

from mme_vla.utils.checksums import SUMS, Sums, check_sums, file_sum, plain, sealed, sum_line, unsealed, write_sums
from mme_vla.utils.io import (
    decoding,
    disk_trouble,
    draft_of,
    inside,
    is_draft,
    is_text,
    name_place,
    parse_json,
    read_bytes,
    read_json,
    read_json_lines,
    read_text,
    remove_drafts,
    require_file,
    safe_name,
    user_cache,
    write_atomically,
    write_json,
)
from mme_vla.utils.locks import PLAN, FolderLock, claim_plan, drop_plan
from mme_vla.utils.processes import files_to_hold

__all__ = [
    "PLAN", "SUMS", "FolderLock", "Sums", "check_sums", "claim_plan", "decoding", "disk_trouble", "draft_of",
    "drop_plan", "file_sum", "files_to_hold", "inside", "is_draft", "is_text", "name_place", "parse_json", "plain",
    "read_bytes", "read_json", "read_json_lines", "read_text", "remove_drafts", "require_file", "safe_name", "sealed",
    "sum_line", "unsealed", "user_cache", "write_atomically", "write_json", "write_sums",
]  # fmt: skip
