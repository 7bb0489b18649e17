"""The published results, one archive a table: unpack them, check them, or pack a new one.

    python scripts/published.py unpack              # all, into outputs/published
    python scripts/published.py unpack nano clock   # some of them
    python scripts/published.py check               # every archive has the digest of the index
    python scripts/published.py pack nano FOLDER    # replace an archive by the files of a folder

An archive keeps the bytes of every file, so records, receipts and their digests are those that were
measured. `benchmarks/results/README.md` is the index.
"""

import argparse
import hashlib
import io
import lzma
import sys
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
BOARD = ROOT / "mme_vla" / "assets" / "board"
INDEX = RESULTS / "SHA256SUMS"
ARCHIVES = {
    "clock": RESULTS / "clock.tar.xz",
    "mikasa24": RESULTS / "mikasa24.tar.xz",
    "nano": RESULTS / "nano.tar.xz",
    "nano16/further": BOARD / "further.tar.xz",
    "nano16/further-waypoint": BOARD / "further-waypoint.tar.xz",
    "ood": RESULTS / "ood.tar.xz",
    "reserved": RESULTS / "reserved.tar.xz",
}
"""Folder below the target → archive, whose files are in a folder of the archive's name."""
BOARD_TABLES = [name for name in ARCHIVES if name.startswith("nano16/")]
TARGET = Path("outputs", "published")


def pack(folder: Path, archive: Path) -> None:
    """Write an archive of a folder: names in order, without times and owners."""
    stored = io.BytesIO()
    with tarfile.open(fileobj=stored, mode="w", format=tarfile.PAX_FORMAT) as tar:
        for file in sorted(folder.rglob("*")):
            if not file.is_file():
                continue
            content = file.read_bytes()
            name = Path(archive.name.partition(".")[0], file.relative_to(folder))
            member = tarfile.TarInfo(name.as_posix())
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    archive.parent.mkdir(parents=True, exist_ok=True)
    archive.write_bytes(lzma.compress(stored.getvalue(), preset=9 | lzma.PRESET_EXTREME))


def unpack(name: str, target: Path = TARGET) -> Path:
    """Unpack an archive below a folder, and return the folder of its files."""
    folder = target / name
    with tarfile.open(ARCHIVES[name]) as tar:
        tar.extractall(folder.parent, filter="data")
    return folder


def replace(name: str, folder: Path) -> None:
    """Pack a folder as a named archive, and write the index anew."""
    pack(folder, ARCHIVES[name])
    INDEX.write_text(sums(), encoding="utf-8")


def sums() -> str:
    """The digests of all archives, as `sha256sum` prints them from `benchmarks/results`."""
    lines = []
    for archive in ARCHIVES.values():
        digest = hashlib.sha256(archive.read_bytes()).hexdigest()
        lines.append(f"{digest}  {archive.relative_to(RESULTS, walk_up=True).as_posix()}\n")
    return "".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    actions = parser.add_subparsers(dest="action", required=True)
    unpacking = actions.add_parser("unpack", help="write the files of archives")
    unpacking.add_argument("names", nargs="*", help=f"of {', '.join(ARCHIVES)}; without: all")
    unpacking.add_argument("--output", type=Path, default=TARGET)
    packing = actions.add_parser("pack", help="replace an archive")
    packing.add_argument("name", choices=ARCHIVES)
    packing.add_argument("folder", type=Path)
    actions.add_parser("check", help="compare the archives with the index")
    args = parser.parse_args()
    if args.action == "check":
        if INDEX.read_text(encoding="utf-8") != sums():
            sys.exit(f"{INDEX.relative_to(ROOT)} does not fit the archives.")
    elif args.action == "pack":
        replace(args.name, args.folder)
    else:
        for name in args.names or ARCHIVES:
            if name not in ARCHIVES:
                parser.error(f"{name}: known are {', '.join(ARCHIVES)}")
            print(f"unpacked {unpack(name, args.output)}")


if __name__ == "__main__":
    main()
