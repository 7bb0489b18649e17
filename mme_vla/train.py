"""`python -m mme_vla.train`: the command is mme_vla/cli/train.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("train")
