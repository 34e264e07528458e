"""Terminal output shared by commands: progress, figures, checks for extras, the progress line of a flight."""
