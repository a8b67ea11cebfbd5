"""Readers of five layouts of posed photographs; all of them return `PosedPhotographs`."""
