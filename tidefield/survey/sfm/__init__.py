"""Structure from motion: features, matches, poses and lenses."""
