"""Memories: each chooses stored vision tokens and encodes them into at most `budget` memory tokens.

Importing this room registers the memories it ships.
"""

from mme_vla.memory import (
    banked,
    framesamp,
    gist,
    joined,
    learned_topk,
    moment,
    own_actions,
    retrieval,
    rmt,
    spacetime,
    tokendrop,
    ttt,
)

__all__ = [
    "banked", "framesamp", "gist", "joined", "learned_topk", "moment", "own_actions", "retrieval", "rmt", "spacetime",
    "tokendrop", "ttt",
]  # fmt: skip
