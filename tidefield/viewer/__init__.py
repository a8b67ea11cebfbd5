"""Looking at runs, scenes, maps and changes in a browser."""
