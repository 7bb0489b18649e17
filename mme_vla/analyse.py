"""`python -m mme_vla.analyse`: the command is mme_vla/commands/analyse.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("analyse")
