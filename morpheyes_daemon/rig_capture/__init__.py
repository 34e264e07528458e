"""Capture of board pictures with the real camera and servo on a table; no flight."""
