"""`python -m mme_vla.inspect`: the command is mme_vla/cli/inspect.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("inspect")
