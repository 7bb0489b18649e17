"""`python -m mme_vla.nano`: the command is mme_vla/extras/nano/cli/nano.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("nano")
