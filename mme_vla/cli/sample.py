"""`mme-vla sample FULL_FOLDER THINNED_FOLDER`: make the shipped dataset, `mme_vla/assets/sample`.

Four real demonstrations, one of them with an image for every step, as a LeRobot v3.0 dataset of
under 6 MB. It exists so that the first command of the README needs nothing else; users need not run
this.
"""

import shutil
from pathlib import Path

from mme_vla.cli.help import argument_parser
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import EpisodeRef
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.errors import UserError, require

# (folder, task, episode): `full` holds one episode with an image a step, `thinned` the others.
EPISODES = (
    ("full", "VideoUnmask", 6),
    ("thinned", "PatternLock", 8),
    ("thinned", "PickXtimes", 8),
    ("thinned", "VideoUnmask", 4),
)
# Lossless luminance, halved colour resolution and few key frames: smaller than lossy video with
# frequent key frames, and a patch in which nothing moves stays exactly the same.
OPTIONS = ConvertOptions(pix_fmt="yuv420p", gop=32)
LIMIT = 6_000_000


def main() -> None:
    """Run `mme-vla sample`."""
    parser = argument_parser(
        "mme-vla sample", str(__doc__).partition("\n")[0], ("full_files thinned_files",)
    )
    parser.add_argument(
        "full", type=Path, help="folder with the VideoUnmask file that has an image for every step"
    )
    parser.add_argument("thinned", type=Path, help="folder with the thinned files")
    parser.add_argument(
        "--output",
        type=Path,
        default=SAMPLE,
        help="new dataset folder (default: inside the package)",
    )
    arguments = parser.parse_args()
    output = arguments.output
    folders = {"full": arguments.full, "thinned": arguments.thinned}
    refs = []
    for kind, task, number in EPISODES:
        ref = EpisodeRef(folders[kind] / f"record_dataset_{task}.h5", number, task)
        require(
            ref.file.is_file(), f"{ref.file} does not exist; the sample needs {ref.group} of it."
        )
        refs.append(ref)
    readme = (SAMPLE / "README.md").read_bytes()  # of the shipped sample, which this replaces
    convert(refs, output, OPTIONS)
    (output / "README.md").write_bytes(readme)
    size = sum(file.stat().st_size for file in output.rglob("*") if file.is_file())
    if size > LIMIT:
        shutil.rmtree(output)
        raise UserError(
            f"The sample would take {size / 1e6:.1f} MB; the limit is {LIMIT / 1e6:.0f} MB."
        )
    print(f"{output}: {size / 1e6:.2f} MB")
