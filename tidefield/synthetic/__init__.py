"""A procedural tidal flat, photographed by a drone, with exact colour, depth and map."""

from tidefield.processes import restore_sigterm
from tidefield.synthetic.settings import CATEGORIES
from tidefield.synthetic.survey import Flight, Survey, make_survey
from tidefield.synthetic.write import write_survey

__all__ = ["CATEGORIES", "Flight", "Survey", "make_survey", "write_survey"]

restore_sigterm()
