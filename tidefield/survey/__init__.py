"""From photographs as the camera wrote them to a Scene on disk."""
