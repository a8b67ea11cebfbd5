"""Structure from motion: features, pairs, matches, poses, lenses."""
