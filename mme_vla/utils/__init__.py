"""Files of the system: reading, writing, locks, checksums. Nothing here depends on what a file means."""

from mme_vla.utils.checksums import SUMS, Sums, check_sums, checked_file, file_sum, sum_line, write_sums
from mme_vla.utils.io import (
    decoding,
    disk_trouble,
    draft_of,
    inside,
    is_alive,
    is_draft,
    is_text,
    name_place,
    parse_json,
    read_bytes,
    read_json,
    read_lines,
    read_text,
    read_unpacked,
    remove_drafts,
    require_file,
    require_replaceable,
    safe_name,
    to_json,
    to_line,
    user_cache,
    verified,
    with_checksum,
    write_atomically,
    write_json,
)
from mme_vla.utils.locks import PLAN, FolderLock, claim_plan, drop_plan
from mme_vla.utils.processes import files_to_hold, started_processes

__all__ = [
    "PLAN", "SUMS", "FolderLock", "Sums", "check_sums", "checked_file", "claim_plan", "decoding", "disk_trouble",
    "draft_of", "drop_plan", "file_sum", "files_to_hold", "inside", "is_alive", "is_draft", "is_text", "name_place",
    "parse_json", "read_bytes", "read_json", "read_lines", "read_text", "read_unpacked", "remove_drafts",
    "require_file", "require_replaceable", "safe_name", "started_processes", "sum_line", "to_json", "to_line",
    "user_cache", "verified", "with_checksum", "write_atomically", "write_json", "write_sums",
]  # fmt: skip
