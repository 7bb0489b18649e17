"""`python -m mme_vla.results`: the command is mme_vla/commands/results.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("results")
