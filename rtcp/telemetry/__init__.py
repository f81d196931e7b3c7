"""Recordings, the live view, experiments and their report, fault reports, trials and the soak."""
