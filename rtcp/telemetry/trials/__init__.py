"""Trials: a running platform on the virtual segment is broken on purpose, and what its arm truly does is measured."""
