"""`python -m mme_vla.results`: the command is mme_vla/commands/results.py."""

from mme_vla.commands.results import main

if __name__ == "__main__":
    main()
