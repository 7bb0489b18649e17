"""Training: the loop, its optimizer and averages, checkpoints, logging, and the open-loop check at
the end.
"""
