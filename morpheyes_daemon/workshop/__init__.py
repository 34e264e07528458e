"""The rig on the table: a person, a board, the real camera and servo, and no flight."""
