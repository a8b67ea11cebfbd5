"""Compare methods on the same photographs, split, resolution, machine and budget: runs, tables and figures."""
