"""`python -m mme_vla.probe`: the command is mme_vla/extras/probing/cli/probe.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("probe")
