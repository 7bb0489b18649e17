"""Memories: each selects stored vision tokens and encodes them into at most `budget`
memory tokens.
"""
