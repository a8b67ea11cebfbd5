"""Evaluation: metrics of held-out photographs, curves, and pictures. Imports nothing heavy by itself."""

EVALUATION_FILE = "evaluation.json"
"""What an evaluation leaves in its folder, last and complete."""
UNFINISHED_FILE = "measured_so_far.json"
"""What there is of one that was interrupted, which the next one of the same goes on from."""
