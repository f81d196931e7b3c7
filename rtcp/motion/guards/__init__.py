"""What stands between a controller and the drives."""
