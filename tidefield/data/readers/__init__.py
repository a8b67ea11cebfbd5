"""Readers of the layouts in which posed photographs come: one module each, all giving `PosedPhotographs`."""
