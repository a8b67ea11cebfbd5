"""Make a Scene on disk from drone photographs: quality, poses, georeference, colour, report."""

import pycolmap  # noqa: F401

from tidefield.processes import restore_sigterm

restore_sigterm()
