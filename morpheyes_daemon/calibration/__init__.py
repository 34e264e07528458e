"""Boards, solver, cross-validation, health checks and the report."""
