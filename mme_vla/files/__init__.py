"""Files as they really are: damaged, shared, half written, from strangers. Nothing here knows what is in them."""

from mme_vla.files.checksums import SUMS, Sums, check_sums, file_sum, sum_line, write_sums
from mme_vla.files.foreign import decoding, require_file
from mme_vla.files.locks import FolderLock
from mme_vla.files.open_files import files_to_hold
from mme_vla.files.places import inside, safe_name, user_cache
from mme_vla.files.plans import PLAN, claim_plan, drop_plan
from mme_vla.files.reading import is_text, parse_json, read_bytes, read_json, read_json_lines, read_text
from mme_vla.files.seals import plain, sealed, unsealed
from mme_vla.files.trouble import disk_trouble, name_place
from mme_vla.files.writing import draft_of, is_draft, remove_drafts, write_atomically, write_json

__all__ = [
    "PLAN", "SUMS", "FolderLock", "Sums", "check_sums", "claim_plan", "decoding", "disk_trouble", "draft_of",
    "drop_plan", "file_sum", "files_to_hold", "inside", "is_draft", "is_text", "name_place", "parse_json", "plain",
    "read_bytes", "read_json", "read_json_lines", "read_text", "remove_drafts", "require_file", "safe_name", "sealed",
    "sum_line", "unsealed", "user_cache", "write_atomically", "write_json", "write_sums",
]  # fmt: skip
