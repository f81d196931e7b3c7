"""Guards between a controller and the drives."""
