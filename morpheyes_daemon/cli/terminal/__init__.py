"""What commands share: progress, figures, optional extras, the line of a flight."""
