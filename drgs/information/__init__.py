"""Behind drgs.fisher, drgs.gain and drgs.select: rows of the Jacobian, their squares, greedy selection."""
