"""The import surface of the RoboMME benchmark over the environments of mme-vla."""

from importlib.metadata import PackageNotFoundError, distribution

try:
    distribution("robomme")
except PackageNotFoundError:
    pass
else:
    raise ImportError(
        "mme-vla-robomme and the official robomme are both installed and own the module `robomme`."
        " Uninstall both, then install the one that you want."
    )
