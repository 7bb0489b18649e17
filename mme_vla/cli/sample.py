"""`mme-vla sample FULL_FOLDER THINNED_FOLDER`: make the dataset that the package ships."""

import argparse
from pathlib import Path

from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.data.sample import make_sample


def main() -> None:
    """Run `mme-vla sample`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("full", type=Path, help="folder with the VideoUnmask file that has an image for every step")
    parser.add_argument("thinned", type=Path, help="folder with the thinned files")
    parser.add_argument("--output", type=Path, default=SAMPLE, help="new dataset folder (default: inside the package)")
    arguments = parser.parse_args()
    size = make_sample(arguments.full, arguments.thinned, arguments.output)
    print(f"{arguments.output}: {size / 1e6:.2f} MB")
