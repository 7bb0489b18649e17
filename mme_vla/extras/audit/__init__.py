"""Audits: what any policy, a served one too, takes from its history, told from outside."""
