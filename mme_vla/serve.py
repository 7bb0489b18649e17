"""`python -m mme_vla.serve`: the command is mme_vla/cli/serve.py."""

from mme_vla.cli import run

if __name__ == "__main__":
    run("serve")
