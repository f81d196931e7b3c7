"""Faults made on the virtual segment while it runs: by command over a socket, and by a script with times."""
