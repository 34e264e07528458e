"""Many flights over seeds and baselines: runner, metrics against ground truth, tables, results page."""
