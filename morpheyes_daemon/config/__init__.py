"""Configuration and mission files: pydantic models, errors that name the YAML line, packaged files."""
