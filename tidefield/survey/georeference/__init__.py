"""A model laid onto the Earth, by GPS or by ground control."""
