"""`mme-vla COMMAND …`, the same as `python -m mme_vla COMMAND …`: the library's commands under one
name.
"""

import sys

import mme_vla
from mme_vla.cli import commands, run
from mme_vla.cli.errors import print_user_errors
from mme_vla.errors import UserError, did_you_mean


def main() -> None:
    """Run the command that the first word names, with the words after it; without one, list the
    commands.
    """
    name, *words = sys.argv[1:] or ["--help"]
    if name in ("-V", "--version"):
        print(f"mme-vla {mme_vla.__version__}")
        return
    is_help = name in ("-h", "--help")
    with print_user_errors():
        known = commands()
        if is_help:
            width = max(map(len, known))
            lines = "\n".join(f"  {name:<{width}}  {of.text}" for name, of in known.items())
            print(
                f"usage: mme-vla COMMAND …\n\n{lines}\n\nmme-vla COMMAND --help says more"
                " of one; mme-vla --version names the version."
            )
        elif name not in known:
            raise UserError(f"There is no command {name!r}. {did_you_mean(name, known)}")
    if is_help:
        return
    sys.argv = [f"mme-vla {name}", *words]
    run(name)


if __name__ == "__main__":
    main()
