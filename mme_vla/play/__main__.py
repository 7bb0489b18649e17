"""`python -m mme_vla.play`: the command is mme_vla/commands/play.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("play")
