"""Integrations: how memory tokens reach the policy."""
