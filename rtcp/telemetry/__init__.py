"""Recordings and reports of what the platform did."""
