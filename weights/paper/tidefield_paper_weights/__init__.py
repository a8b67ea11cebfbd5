"""Trained weights of Tidefield's preset `paper`: `paper.safetensors`, next to this file."""
