"""Board pictures taken with the real camera and servo on a table; no flight."""
