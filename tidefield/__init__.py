"""New views of tidal flats from drone photographs."""

__version__ = "0.1.0"
