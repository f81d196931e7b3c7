"""What is made of cycle records after the cycle: recordings, experiments, pictures."""
