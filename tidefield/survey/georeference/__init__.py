"""Georeferencing of models: GPS alignment, ground control and bundle adjustment."""
