"""The clock, scheduling and memory locking, the discipline of distributed clocks, cycle statistics."""
