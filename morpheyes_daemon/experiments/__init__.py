"""The paper's figures and tables, and campaigns over many seeds."""
