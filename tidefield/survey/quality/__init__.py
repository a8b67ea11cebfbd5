"""Which photographs do a survey more harm than good."""
