"""The process that sees: the perception pipeline inline or in a process with frames in shared memory."""
