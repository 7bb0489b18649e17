"""`python -m mme_vla.play`: the command is mme_vla/extras/play/cli.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("play")
