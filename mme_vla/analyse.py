"""`python -m mme_vla.analyse`: the command is mme_vla/commands/analyse.py."""

from mme_vla.commands.analyse import main

if __name__ == "__main__":
    main()
