"""Speed and accuracy measured: depth, gap detection, vision latency, soak; each a command of `morpheyes bench`."""
