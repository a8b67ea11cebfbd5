"""Evaluation: metrics of held-out photographs, curves, and pictures. Imports nothing heavy by itself."""

EVALUATION_FILE = "evaluation.json"
"""What an evaluation leaves in its folder, last and complete."""
