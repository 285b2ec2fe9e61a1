"""Behind drgs.train: photographs, losses, steps, density control, views chosen on the way."""
