"""Integrations: how memory tokens reach the policy. Importing this room registers those it ships."""

from mme_vla.integration import context, expert, feature_wise, modulator

__all__ = ["context", "expert", "feature_wise", "modulator"]
