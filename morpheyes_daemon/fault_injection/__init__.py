"""Faults x states of the state machine, each flown: injectors, expectations, matrix, report."""
