"""The page to watch; it reads and never commands."""
