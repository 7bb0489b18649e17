"""`python -m mme_vla.serve`: the command is mme_vla/commands/serve.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("serve")
