"""Motion controllers: what moves the set-points on by a cycle."""
