"""Motion in joint space: the generator of set-points, the drive modes that carry them, the guard behind both."""
