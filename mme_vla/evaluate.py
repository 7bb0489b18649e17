"""`python -m mme_vla.evaluate`: the command is mme_vla/cli/evaluate.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("evaluate")
