"""`python -m mme_vla.inspect`: the command is mme_vla/commands/inspect.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("inspect")
