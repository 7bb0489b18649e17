"""The paper's analyses of what memory does, one module each; `python -m
mme_vla.analyse` runs them.
"""
