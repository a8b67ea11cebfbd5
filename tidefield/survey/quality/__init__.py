"""Assess the quality of photographs before reconstruction."""
