"""The paper's error analysis, figures and path-traced stills."""
