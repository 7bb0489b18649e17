"""Integrations: how memory tokens reach the policy. Importing this room registers those it ships."""

from mme_vla.integration import context, expert, film, modulator

__all__ = ["context", "expert", "film", "modulator"]
