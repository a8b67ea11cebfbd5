"""Make a Scene on disk from drone photographs: quality, poses, georeference, colour, report."""
