"""The import surface of the RoboMME benchmark over the environments of mme-vla."""

STANDS_IN = "mme_vla"
"""Whose environments these are: the official package has no such name."""
