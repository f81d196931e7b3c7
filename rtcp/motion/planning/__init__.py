"""Plans for trajectories and straight lines, checked whole before anything moves. Outside the cycle; no numpy."""
