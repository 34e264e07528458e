"""The forest mission: fly to a goal among obstacles."""
