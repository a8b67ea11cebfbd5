"""What a surveyor brings, read: photographs with EXIF and XMP, positions, ground control."""
