"""Analysis of cycle records and fault injection: recordings, the square, fault reports, trials and the soak."""
