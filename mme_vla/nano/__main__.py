"""`python -m mme_vla.nano`: the command is mme_vla/commands/nano.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("nano")
