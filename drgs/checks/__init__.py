"""Arguments and names that are refused in one line, where they are wrong."""
