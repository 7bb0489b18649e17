"""`python -m mme_vla.play`: the command is mme_vla/cli/play.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("play")
