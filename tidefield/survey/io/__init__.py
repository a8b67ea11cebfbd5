"""Read the inputs of a survey: photographs with EXIF and XMP, positions, ground control."""
