"""Faults on the running virtual segment, by command over a socket or by a timed script."""
