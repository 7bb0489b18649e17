"""`python -m mme_vla.analyse`: the command is mme_vla/extras/probing/cli/analyse.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("analyse")
