"""One module per command: its options, which make its part of the command line, and its function.

The options are imported to answer --help, so heavy imports stand inside the functions.
"""
