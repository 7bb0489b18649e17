"""Memories: each chooses stored vision tokens and encodes them into at most `budget` memory tokens.

Importing this room registers the memories it ships.
"""

from mme_vla.memory import actions, framesamp, gist, joined, learned_topk, moment, retrieval, rmt, tokendrop, ttt

__all__ = ["actions", "framesamp", "gist", "joined", "learned_topk", "moment", "retrieval", "rmt", "tokendrop", "ttt"]
