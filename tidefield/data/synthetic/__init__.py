"""A procedural tidal flat, photographed by a drone, with exact colour, depth and map."""

from tidefield.data.synthetic.settings import CATEGORIES
from tidefield.data.synthetic.survey import Flight, Survey, make_survey
from tidefield.data.synthetic.write import write_survey

__all__ = ["CATEGORIES", "Flight", "Survey", "make_survey", "write_survey"]
