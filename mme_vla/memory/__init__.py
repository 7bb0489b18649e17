"""Memories: each chooses stored vision tokens and encodes them into at most `budget` memory tokens.

Importing this room registers the memories it ships.
"""

from mme_vla.memory import framesamp, joined, rmt, tokendrop, ttt

__all__ = ["framesamp", "joined", "rmt", "tokendrop", "ttt"]
