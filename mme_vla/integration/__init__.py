"""Integrations: how memory tokens reach the policy. Importing this room registers the three it ships."""

from mme_vla.integration import context, expert, modulator

__all__ = ["context", "expert", "modulator"]
