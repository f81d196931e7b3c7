"""The control socket, planning outside the cycle, the black box."""
