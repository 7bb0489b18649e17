"""`python -m mme_vla.probe`: the command is mme_vla/commands/probe.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("probe")
