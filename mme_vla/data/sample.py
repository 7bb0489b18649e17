"""`python -m mme_vla.data.sample`: the command is mme_vla/commands/sample.py."""

from mme_vla.commands.sample import main

if __name__ == "__main__":
    main()
