"""`python -m mme_vla.results`: the command is mme_vla/cli/results.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("results")
